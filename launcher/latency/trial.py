"""One trial of the whole system at one rate: its configuration, and what it came to, tick by tick."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from env_server.worlds import registry as worlds
from launcher.quantiles import Nanoseconds, Quantiles, quantiles_us
from rtcore.config import RunConfig
from rtcore.config_check import check
from rtcore.messages import Step
from rtcore.realtime import Rt

Load = Literal["none", "learner"]
Quantity = Literal["pacing", "loop", "reaction"]

SATURATING_UTD = 100.0  # gradient steps per transition: no machine reaches it at any rate measured here
IDLE_UPDATES_PER_S = 1.0  # so that networks are published and acted with, as in any run


@dataclass
class Series:
    """What every executed tick was like, in order. Latencies are -1 where a tick has none."""

    tick: array[int] = field(default_factory=lambda: array("q"))
    pacing_ns: array[int] = field(default_factory=lambda: array("q"))
    loop_ns: array[int] = field(default_factory=lambda: array("q"))
    reaction_ns: array[int] = field(default_factory=lambda: array("q"))
    missed: array[int] = field(default_factory=lambda: array("b"))

    def add(self, steps: Sequence[Step]) -> None:
        """Take in further steps of the log."""
        for step in steps:
            self.tick.append(step.tick)
            self.pacing_ns.append(step.woke_ns - step.due_ns)
            self.loop_ns.append(max(step.loop_ns, step.late_loop_ns))
            self.reaction_ns.append(max(step.reaction_ns, step.late_reaction_ns))
            self.missed.append(step.missed)


@dataclass(frozen=True)
class Trial:
    """What one run of the system came to.

    Attributes:
        hz, load, rt: the conditions.
        ticks, missed, overruns, skipped: as in summary.json.
        causes: misses by cause, those that occurred.
        updates_per_s: gradient steps of the learner per second.
        placement: what each process obtained, in words.
        tick, pacing_ns, loop_ns, reaction_ns, was_missed: one element per tick that the log's reader saw.
        steal_s: what the host took while the run lasted, over all processors; None where it is not told.
        span_s: how long that was.
        interrupted: it was ended before its time.
    """

    hz: float
    load: Load
    rt: Rt
    ticks: int
    missed: int
    overruns: int
    skipped: int
    causes: dict[str, int]
    updates_per_s: float | None
    placement: dict[str, str]
    tick: Nanoseconds
    pacing_ns: Nanoseconds
    loop_ns: Nanoseconds
    reaction_ns: Nanoseconds
    was_missed: npt.NDArray[np.bool_]
    steal_s: float | None
    span_s: float
    interrupted: bool

    @property
    def unseen(self) -> int:
        """Executed ticks that the log's reader did not get: they are in the counts, not in the series."""
        return self.ticks - len(self.tick)

    @property
    def miss_ratio(self) -> float:
        """Misses per executed tick."""
        return self.missed / max(1, self.ticks)

    def since(self, after_s: float) -> tuple[int, int]:
        """(ticks, misses) from `after_s` seconds of run time on."""
        late = self.tick >= after_s * self.hz
        return int(late.sum()), int(self.was_missed[late].sum())

    def quantiles_us(self, name: Quantity, after_s: float = 0.0) -> Quantiles:
        """{p50, p99, p999, max} from `after_s` seconds of run time on."""
        values: Nanoseconds = getattr(self, f"{name}_ns")
        return quantiles_us(values[(self.tick >= after_s * self.hz) & (values >= 0)])


def trial_config(
    base: RunConfig, *, hz: float, load: Load, seconds: float, rt: Rt, record: bool = False
) -> RunConfig:
    """The run behind a trial: `base` at another rate, and with a learner that saturates, or hardly learns.

    Raises:
        ConfigError: `base` cannot be run so.
    """
    learner = base.learner
    config = replace(
        base,
        duration_s=seconds,
        env=replace(base.env, hz=hz, speed=None),
        agent=replace(base.agent, rt=rt),
        learner=replace(
            learner,
            utd=SATURATING_UTD if load == "learner" else IDLE_UPDATES_PER_S / hz,
            learning_starts=min(learner.learning_starts, learner.batch),
        ),
        recorder=replace(base.recorder, record=record),
        supervise=replace(base.supervise, limit=0),  # what somebody died in is no measurement
    )
    check(config)
    return replace(config, env=worlds.resolve(config.env))
