"""What is written: rows of an entity, on the recording's timelines. Pure, knows no file format.

Every row stands on all five timelines: `run_time` (ns since T0), `wall` (Unix ns), `tick`, `episode`
and `unit`. A step brings its own tick, episode and unit; for anything else they follow from the time.

The environments of a fleet tick by turns: that of number i of n has a T0 of its own, i/n of a tick after the
run's, and `run_time` is since that. So equal ticks have equal run times, but `wall`, which is true of all,
differs by less than a tick. An episode is one environment's own.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rtcore.cast import env_names
from rtcore.config import EnvConfig
from rtcore.messages import Spec, Step

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]

EPISODES = 64  # telemetry is seconds old at most, so even of 0.2 s they are enough


@dataclass(frozen=True, slots=True)
class Index:
    """Where n rows stand on the timelines; int64 [n] each."""

    run_time_ns: Ints  # since T0; negative before it
    wall_ns: Ints  # Unix time
    tick: Ints
    episode: Ints
    unit: Ints

    def __len__(self) -> int:
        return len(self.run_time_ns)

    @classmethod
    def joined(cls, parts: Sequence[Index]) -> Index:
        """The rows of all parts, one after the other."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def where(self, mask: NDArray[np.bool_]) -> Index:
        """The rows where `mask` (bool [n]) is true."""
        return Index(
            self.run_time_ns[mask], self.wall_ns[mask], self.tick[mask], self.episode[mask], self.unit[mask]
        )


@dataclass(frozen=True, slots=True)
class Scalars:
    """float64 [n, k]: k series; NaN draws a gap."""

    values: Floats


@dataclass(frozen=True, slots=True)
class States:
    """n names; each lasts until the next."""

    names: Sequence[str]


@dataclass(frozen=True, slots=True)
class Lines:
    """n log lines with their levels."""

    texts: Sequence[str]
    levels: Sequence[str]


@dataclass(frozen=True, slots=True)
class Poses:
    """World pose of one body: metres, float32 [n, 3]; rotation, float32 [n, 4] as xyzw (None: not turned)."""

    translation: Singles
    quaternion: Singles | None = None


Payload = Scalars | States | Lines | Poses


@dataclass(frozen=True, slots=True)
class Rows:
    """n rows of one entity."""

    entity: str
    index: Index
    payload: Payload


def roots(env: EnvConfig) -> dict[str, str]:
    """By environment, the entity below which its own ones lie: "", or of a fleet `/env0`, `/env1`, ...

    What could not stand in an entity's path is an underscore there; a number ends each name.
    """
    names = env_names(env)
    if len(names) == 1:
        return {names[0]: ""}
    return {name: "/" + re.sub(r"[^\w.-]", "_", name, flags=re.ASCII) for name in names}


class Timeline:
    """Turns monotonic stamps into places on the five timelines.

    T0 is the first env server's: the timeline goes on when an env server comes back with a later one.

    Args:
        spec: says T0, and how long a tick and a unit are.
        episodes: the newest ones that were remembered before; see `episodes`.
    """

    def __init__(self, spec: Spec, episodes: Sequence[tuple[int, int]] = ()) -> None:
        self._t0_ns = spec.t0_ns
        self._wall_t0_ns = spec.wall_t0_ns
        self._tick_ns = spec.tick_ns
        self._unit_ns = spec.unit_ns
        self._episodes = [episode for episode, _ in episodes]
        # Run time of each one's first step seen, rising.
        self._episode_starts_ns = [at_ns for _, at_ns in episodes]

    @property
    def episodes(self) -> list[tuple[int, int]]:
        """(number, run time in ns of its first step seen) of the newest 64 episodes, in order."""
        newest = slice(-EPISODES, None)
        return list(zip(self._episodes[newest], self._episode_starts_ns[newest], strict=True))

    def remember(self, steps: Sequence[Step]) -> None:
        """Learn where episodes begin, from steps in order."""
        for step in steps:
            if not self._episodes or step.episode != self._episodes[-1]:
                self._episodes.append(step.episode)
                self._episode_starts_ns.append(step.due_ns - self._t0_ns)
        if len(self._episodes) > 2 * EPISODES:
            del self._episodes[:-EPISODES], self._episode_starts_ns[:-EPISODES]

    def of_steps(self, steps: Sequence[Step]) -> Index:
        """At their deadlines, with their own tick, episode and unit."""
        run_time = np.array([step.due_ns for step in steps], np.int64) - self._t0_ns
        return Index(
            run_time,
            run_time + self._wall_t0_ns,
            np.array([step.tick for step in steps], np.int64),
            np.array([step.episode for step in steps], np.int64),
            np.array([step.unit for step in steps], np.int64),
        )

    def of_stamps(self, at_ns: Sequence[int]) -> Index:
        """At any instants: tick = floor(run_time / dt), unit likewise, episode of the newest step until then.

        Before T0 all three are 0.
        """
        run_time = np.array(at_ns, np.int64) - self._t0_ns
        since_t0 = np.maximum(run_time, 0)
        return Index(
            run_time,
            run_time + self._wall_t0_ns,
            since_t0 // self._tick_ns,
            np.array([self._episode_at(at) for at in run_time.tolist()], np.int64),
            since_t0 // self._unit_ns,
        )

    def _episode_at(self, run_time_ns: int) -> int:
        place = bisect_right(self._episode_starts_ns, run_time_ns) - 1
        return self._episodes[place] if place >= 0 else 0
