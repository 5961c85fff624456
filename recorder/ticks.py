"""From steps to rows: what happened at every tick. Pure; remembers only the episode that runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import nan

import numpy as np

from recorder.place import Carried
from recorder.rows import Floats, Index, Rows, Scalars, Timeline
from rtcore.config import EnvConfig
from rtcore.messages import Spec, Step

PHYSICS = "/env/physics"
PHYSICS_SERIES = ("mass", "friction", "gravity")  # factors, in the order of `Step.physics`
MISSED = "/agent/missed"  # and, below it, a series for each cause


class TickRows:
    """Builds the rows of `/env/**` and `/agent/**`.

    Args:
        timeline: places rows on the timelines.
        speed_per_m: what one metre travelled along the first coordinate within one tick is worth in the
            units of the drift (k_f / native period in s); None: the drift is no speed.
        carried: from the step before the first one; None: there is none.
    """

    def __init__(
        self, timeline: Timeline, speed_per_m: float | None = None, carried: Carried | None = None
    ) -> None:
        self._timeline = timeline
        self._speed_per_m = speed_per_m
        self._previous = carried
        self._return = None if carried is None else carried.episode_return

    @property
    def carried(self) -> Carried | None:
        """From the last step; None: there was none."""
        return self._previous

    def rows(self, steps: Sequence[Step]) -> list[Rows]:
        """Rows of consecutive steps, continuing those of the previous call; at least one step."""
        self._timeline.remember(steps)
        index = self._timeline.of_steps(steps)
        speed, returns = self._walk(steps)
        versions = _column(step.policy_version for step in steps)
        tables = [
            Rows("/env/reward", index, _series(_column(step.reward for step in steps))),
            Rows("/env/drift", index, self._drift(steps, speed)),
            Rows("/env/pacing_us", index, _series(_column((s.woke_ns - s.due_ns) / 1e3 for s in steps))),
            Rows("/agent/loop_us", index, _series(_column(_microseconds(s.loop_ns) for s in steps))),
            Rows("/agent/reaction_us", index, _series(_column(_microseconds(s.reaction_ns) for s in steps))),
            Rows(MISSED, index, _series(_column(step.missed for step in steps))),
            _sparse("/agent/policy_version", index, np.where(versions >= 0, versions, np.nan)),
            _sparse("/env/return", index, returns),
            *_physics(steps, index),
            *self._causes(steps, index),
        ]
        return [table for table in tables if len(table.index)]

    @staticmethod
    def _causes(steps: Sequence[Step], index: Index) -> list[Rows]:
        """A row of 1 per miss on the series of its cause: their numbers add up to the misses."""
        found = {step.cause for step in steps if step.missed and step.cause}
        return [
            _sparse(
                f"{MISSED}/{cause}",
                index,
                _column(1.0 if step.missed and step.cause == cause else float("nan") for step in steps),
            )
            for cause in sorted(found)
        ]

    def _drift(self, steps: Sequence[Step], speed: Floats) -> Scalars:
        target = _column(step.drift for step in steps)
        return _series(target) if self._speed_per_m is None else _series(target, speed)

    def _walk(self, steps: Sequence[Step]) -> tuple[Floats, Floats]:
        """Speed and return per step; NaN where there is none."""
        speed = np.full(len(steps), np.nan)
        returns = np.full(len(steps), np.nan)
        for i, step in enumerate(steps):
            follows = self._follows(step)
            if step.episode_tick == 0:
                self._return = 0.0
            elif not follows:
                self._return = None
            if self._return is not None:
                self._return += step.reward
                if step.terminated or step.truncated:
                    returns[i] = self._return
            first = nan if self._speed_per_m is None else _first(step)
            if follows and step.episode_tick > 0 and self._speed_per_m is not None and self._previous:
                speed[i] = (first - self._previous.first) * self._speed_per_m
            self._previous = Carried(step.incarnation, step.seq, first, self._return)
        return speed, returns

    def _follows(self, step: Step) -> bool:
        last = self._previous
        return last is not None and (last.incarnation, last.seq + 1) == (step.incarnation, step.seq)


def speed_per_m(spec: Spec, env: EnvConfig) -> float | None:
    """See `TickRows`; None for a world without a drifting target: where there is one, it is a speed."""
    if env.drift.still or spec.scene == "" or spec.native_period_ns == 0:
        return None
    return env.reward.k_f * 1e9 / spec.native_period_ns


def _physics(steps: Sequence[Step], index: Index) -> list[Rows]:
    """The factors of a world whose physics drift; the environment's configuration says for all steps."""
    if not all(len(step.physics) == len(PHYSICS_SERIES) for step in steps):
        return []
    return [Rows(PHYSICS, index, Scalars(np.array([step.physics for step in steps], np.float64)))]


def _first(step: Step) -> float:
    """The first coordinate, in metres; NaN where the world gives no position."""
    return float(np.frombuffer(step.position, "<f8", count=1)[0]) if len(step.position) >= 8 else float("nan")


def _microseconds(duration_ns: int) -> float:
    return duration_ns / 1e3 if duration_ns >= 0 else float("nan")


def _column(values: Iterable[float]) -> Floats:
    return np.array(list(values), np.float64)


def _series(*columns: Floats) -> Scalars:
    return Scalars(np.stack(columns, axis=1))


def _sparse(entity: str, index: Index, values: Floats) -> Rows:
    """Rows of only those steps that have a value."""
    there = ~np.isnan(values)
    return Rows(entity, index.where(there), _series(values[there]))
