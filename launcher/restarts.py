"""When a process that died is started again, and when the run is given up. Pure: it is told the time."""

from __future__ import annotations

import signal
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Literal

from launcher.vitals import START_NS
from rtcore.config import SuperviseConfig
from rtcore.process import WRONG_INPUT

What = Literal["died", "stuck", "starved", "restarted", "gave_up"]

HUNG = "hung and was killed"
MOST_DOUBLINGS = 60  # beyond it any first delay is above any most


@dataclass(frozen=True, slots=True)
class Happening:
    """Something that the launcher saw or did.

    Attributes:
        at_ns: when, on the monotonic clock.
        process: to whom.
        what: each death is one "died" or "stuck"; each further life one "restarted"; "starved" is a silence
            for want of a core.
        code: the exit code, negative: the signal; None: it has none.
        text: for people.
    """

    at_ns: int
    process: str
    what: What
    code: int | None
    text: str


@dataclass(frozen=True, slots=True)
class Again:
    """It is started again, `delay_s` after its death."""

    delay_s: float


@dataclass(frozen=True, slots=True)
class GiveUp:
    """It is not started again, and the run ends; `why` goes on from the process's name."""

    why: str


@dataclass
class _Row:
    """Deaths in a row.

    Attributes:
        hows: how each life of it ended.
        next_s: when the next life begins.
    """

    hows: list[str] = field(default_factory=list)
    next_s: float = 0.0


class Restarts:
    """The policy of one run. Each process's deaths count for themselves.

    It counts deaths in a row, not deaths within a time: lives that each end in a hang last `stuck_s` and
    more, so that any window holds only a few of them.
    """

    def __init__(self, config: SuperviseConfig) -> None:
        self._config = config
        self._rows: defaultdict[str, _Row] = defaultdict(_Row)

    def died(self, process: str, now_s: float, code: int, *, hung: bool = False) -> Again | GiveUp:
        """Enter a death and decide.

        The first delay is `first_s`; it doubles with each further death in a row, up to `most_s`. A life that
        lasted `within_s` ends the row: its own death is the first of another. The time that a hang may have
        taken does not count as life. Exit code 2 says that the input is wrong, which no restart changes.

        Args:
            process: who.
            now_s: when.
            code: its exit code; negative: the signal.
            hung: it was killed for that.
        """
        lived_s = now_s - self._rows[process].next_s
        if hung:
            lived_s -= max(START_NS / 1e9, self._config.stuck_s)
        if lived_s >= self._config.within_s:
            del self._rows[process]
        row = self._rows[process]
        row.hows.append(HUNG if hung else describe(code))
        if code == WRONG_INPUT:
            return GiveUp(f"cannot work with what it was given ({describe(code)})")
        if len(row.hows) > self._config.limit:
            return GiveUp(self._why(row.hows))
        doubled = self._config.first_s * 2 ** min(len(row.hows) - 1, MOST_DOUBLINGS)
        delay_s = min(doubled, self._config.most_s)
        row.next_s = now_s + delay_s
        return Again(delay_s)

    def _why(self, hows: list[str]) -> str:
        if len(hows) == 1:
            return f"ended unexpectedly ({hows[0]})"
        counted = Counter(hows)
        each = ", ".join(how if n == 1 else f"{n} x {how}" for how, n in counted.items())
        return f"died {len(hows)} times in a row ({each})"


def describe(code: int) -> str:
    """An exit code as `subprocess` has it, in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:  # a real-time signal has no name
        return f"signal {-code}"
