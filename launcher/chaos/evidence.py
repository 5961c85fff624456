"""What a run left behind, as the judge takes it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from env_server.worlds.period import num_ticks
from launcher.chaos.faults import Done
from launcher.report import load
from launcher.summary import Summary
from learner import marks
from rtcore.cast import Part, env_names, of_role, role_of
from rtcore.channels import AGENT, LEARNER, PER_ENV, RECORDER
from rtcore.config import ConfigError
from rtcore.run_dir import RunDir

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

SHARED = ("published", "last_version")  # counters of the learner that are of every environment
# What the agent says of a version that must not act. Two kinds of refusal say nothing against it: it is older
# than what was there before, and may have acted then; what came by its number is not what the learner sent.
NOT_OF_THE_VERSION = r"version \d+ was there before|it is not signed|its signature|sha256 differs"
REFUSED = re.compile(rf"policy (\d+) refused: (?!{NOT_OF_THE_VERSION})")


@dataclass(frozen=True, slots=True)
class Life:
    """One life of a process: its counters at its end, however that came, and whether it ended in order."""

    counters: Mapping[str, int]
    ended: bool


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What the recording says.

    Attributes:
        ticks: int64 [n], the ticks with a row, in order; one with two rows is there twice.
        pacing_us: float64 [n], how late the env server was for each.
        acted: int64 [m], the policy versions behind the ticks that had one, in order of the ticks.
        published: int64 [k], the versions published, in order of their stamps.
        problem: why it cannot be read; empty: it can.
    """

    ticks: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    pacing_us: Floats = field(default_factory=lambda: np.empty(0, np.float64))
    acted: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    published: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Everything that the judge goes by.

    Attributes:
        done: the faults.
        ended: the run is over; else some of it is still on its way.
        tick_s: the control period.
        num_ticks: deadlines in the run's duration; None: it has none.
        summary: summary.json; None: there is none.
        lives: of each process, by name, oldest first.
        recorded: the recording; of a fleet what its environments share.
        refused: versions that the agent refused for what was in them.
        kept: transitions that the learner's replay says were ever added to it; None: nobody can tell.
        env: whose evidence it is; empty: that of the run.
        fleet: of each environment; empty: there is one, and this is its.
    """

    done: Sequence[Done]
    ended: bool
    tick_s: float
    num_ticks: int | None
    summary: Summary | None
    lives: Mapping[str, Sequence[Life]]
    recorded: Recorded
    refused: frozenset[int] = frozenset()
    kept: int | None = None
    env: str = ""
    fleet: tuple[Evidence, ...] = ()

    def of_role(self, role: str) -> list[Life]:
        """All lives of the processes of a role."""
        return [life for name, lives in self.lives.items() if role_of(name) == role for life in lives]

    def total(self, role: str, counter: str) -> int:
        """A counter, over all lives of the processes of a role."""
        return sum(life.counters.get(counter, 0) for life in self.of_role(role))

    def of(self, index: int, env: str, recorded: Recorded, refused: frozenset[int] = frozenset()) -> Evidence:
        """An environment's own, as if it had the run for itself: its env server and its agent are called by
        their roles, other environments' by their names. The replay is everybody's.

        Args:
            index: of the environment.
            env: its name.
            recorded: the recording of it.
            refused: versions that its agent refused for what was in them.
        """
        own = {Part(role, index).name: role for role in PER_ENV}
        lives = {role: self.lives.get(name, ()) for name, role in own.items()}
        done = [
            replace(one, fault=replace(one.fault, process=own.get(one.fault.process, one.fault.process)))
            for one in self.done
        ]
        return replace(
            self,
            done=done,
            lives=lives
            | {
                LEARNER: [_own(life, env) for life in self.lives.get(LEARNER, ())],
                RECORDER: self.lives.get(RECORDER, ()),
            },
            recorded=recorded,
            refused=refused,
            kept=None,
            env=env,
        )


def _own(life: Life, env: str) -> Life:
    """The learner's life with an environment's counters in place of the totals that there are of it."""
    ending = f".{env}"
    own = {name.removesuffix(ending): count for name, count in life.counters.items() if name.endswith(ending)}
    shared = {name: life.counters[name] for name in SHARED if name in life.counters}
    return Life(shared | own, life.ended)


def gather(run_dir: RunDir, done: Sequence[Done], *, ended: bool) -> Evidence:
    """Read what is there.

    Raises:
        ConfigError: the run's configuration cannot be read.
    """
    config = run_dir.config()
    assert config.env.hz is not None, "a run's configuration is resolved"
    # The recording first: while a run goes on, its counters are then ahead of the rows.
    envs = env_names(config.env)
    prefixes = [f"/{env}" for env in envs] if len(envs) > 1 else [""]
    recorded = [read_recording(run_dir.recording_path, prefix) for prefix in prefixes]
    lives: dict[str, list[Life]] = {}
    for stats in run_dir.read_final_stats():
        lives.setdefault(stats.process, []).append(Life(stats.counters, stats.final))
    summary = None
    with suppress(ConfigError):
        summary = load(run_dir)
    told = [refused(run_dir.log_path(agent)) for agent in of_role(config, AGENT)]
    whole = Evidence(
        done=done,
        ended=ended,
        tick_s=1 / config.env.hz,
        num_ticks=num_ticks(config.env, config.duration_s) or None,
        summary=summary,
        lives=lives,
        recorded=recorded[0],
        refused=told[0],
        kept=_kept(run_dir.learner_dir / "replay" / "marks.bin"),
    )
    if len(envs) == 1:
        return whole
    rows = zip(envs, recorded, told, strict=True)
    shared = Recorded(published=recorded[0].published, problem=recorded[0].problem)
    return replace(
        whole,
        recorded=shared,
        refused=frozenset(),
        fleet=tuple(whole.of(index, *row) for index, row in enumerate(rows)),
    )


def read_recording(path: Path, prefix: str = "") -> Recorded:
    """Read it as far as it goes; `prefix` is before the names of what is an environment's own."""
    from recorder import reading  # loads the recording's library

    try:
        ticks, pacing = reading.columns(path, f"{prefix}/env/pacing_us")
        _, acted = reading.columns(path, f"{prefix}/agent/policy_version")
        _, published = reading.columns(path, "/learner/published_version", timeline="run_time")
    except (RuntimeError, OSError, ValueError) as error:
        return Recorded(problem=" ".join(str(error).split()) or type(error).__name__)
    return Recorded(
        ticks=ticks,
        pacing_us=pacing[:, 0] if pacing.size else np.empty(0, np.float64),
        acted=acted.ravel().astype(np.int64),
        published=published.ravel().astype(np.int64),
    )


def refused(log: Path) -> frozenset[int]:
    """Versions that the agent's log says it refused for what was in them."""
    found = set()
    with suppress(OSError):
        for line in log.read_text(errors="replace").splitlines():
            with suppress(ValueError, KeyError, TypeError):
                if match := REFUSED.search(json.loads(line)["text"]):
                    found.add(int(match[1]))
    return frozenset(found)


def _kept(path: Path) -> int | None:
    try:
        record = marks.read(path)
    except OSError:
        return None
    return None if record is None else record.added
