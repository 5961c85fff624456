"""Which ticks belong to which life of the env server, and which lie beside a fault. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launcher.chaos.evidence import Evidence, Life
from launcher.chaos.plan import Kind
from rtcore.channels import ENV_SERVER

# Ticks so close to a stop or a death of the env server itself, or to the beginning of one of its lives, are
# not held against it.
OWN_S = 0.5
# After another process's fault: it starts again, imports, catches up. A learner does so for 2 to 5 s.
AFTER_S: dict[Kind, float] = {"kill": 5.0, "stop": 1.0, "slow": 1.0, "fill": 1.0, "partition": 5.0}


@dataclass(frozen=True, slots=True)
class Span:
    """The ticks [first, end) of one life of the env server, `rows` of which are recorded.

    Attributes:
        head: ticks before the first recorded one.
        holes: ticks without a row between the first recorded one and the last.
    """

    life: Life
    first: int
    end: int
    rows: int
    head: int
    holes: int


def lay_out(lives: Sequence[Life], ticks: NDArray[np.int64]) -> list[Span]:
    """Which ticks each life of the env server had, by its counters: they account for every deadline."""
    found, first = [], 0
    for life in lives:
        count = life.counters.get
        if not count("lives", 0):  # it never began
            continue
        first += count("down", 0)
        end = first + count("ticks", 0) + count("skipped", 0)
        own = ticks[(ticks >= first) & (ticks < end)]
        head, holes = (int(own[0]) - first, int(own[-1] - own[0]) + 1 - len(own)) if len(own) else (0, 0)
        found.append(Span(life, first, end, len(own), head, holes))
        first = end
    return found


def masks(evidence: Evidence) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Of the recorded ticks: those in quiet, and those beside other processes' faults alone."""
    at_s = evidence.recorded.ticks * evidence.tick_s
    own, others = np.zeros(len(at_s), bool), np.zeros(len(at_s), bool)
    for one in evidence.done:
        if one.at_s is None:
            continue
        if one.fault.process == ENV_SERVER:
            own |= (at_s >= one.at_s - OWN_S) & (at_s <= one.until_s + OWN_S)
        else:
            others |= (at_s >= one.at_s) & (at_s <= one.until_s + AFTER_S[one.fault.kind])
    for span in lay_out(evidence.lives.get(ENV_SERVER, ()), evidence.recorded.ticks):
        begin_s = span.first * evidence.tick_s
        own |= (at_s >= begin_s) & (at_s <= begin_s + OWN_S)
    return ~own & ~others, ~own & others
