"""When a process that died is started again, and when the run is given up. Pure: it is told the time."""

from __future__ import annotations

import signal
from collections import Counter, defaultdict, deque
from dataclasses import dataclass
from typing import Literal

from rtcore.config import SuperviseConfig
from rtcore.process import WRONG_INPUT

What = Literal["died", "stuck", "restarted", "gave_up"]

HUNG = "hung and was killed"
MOST_DOUBLINGS = 60  # beyond it any first delay is above any most


@dataclass(frozen=True, slots=True)
class Happening:
    """Something that the launcher saw or did.

    Attributes:
        at_ns: when, on the monotonic clock.
        process: to whom.
        what: each death is one "died" or "stuck"; each further life one "restarted".
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


class Restarts:
    """The policy of one run. Each process's deaths count for themselves."""

    def __init__(self, config: SuperviseConfig) -> None:
        self._config = config
        self._deaths: defaultdict[str, deque[tuple[float, str]]] = defaultdict(deque)

    def died(self, process: str, now_s: float, code: int, *, hung: bool = False) -> Again | GiveUp:
        """Enter a death and decide.

        The first delay is `first_s`; it doubles with each further death within `within_s`, up to `most_s`.
        Exit code 2 says that the input is wrong, which no restart changes.

        Args:
            process: who.
            now_s: when.
            code: its exit code; negative: the signal.
            hung: it was killed for that.
        """
        deaths = self._deaths[process]
        deaths.append((now_s, HUNG if hung else describe(code)))
        while now_s - deaths[0][0] > self._config.within_s:
            deaths.popleft()
        if code == WRONG_INPUT:
            return GiveUp(f"cannot work with what it was given ({describe(code)})")
        if len(deaths) > self._config.limit:
            return GiveUp(self._why(deaths))
        doubled = self._config.first_s * 2 ** min(len(deaths) - 1, MOST_DOUBLINGS)
        return Again(min(doubled, self._config.most_s))

    def _why(self, deaths: deque[tuple[float, str]]) -> str:
        if len(deaths) == 1:
            return f"ended unexpectedly ({deaths[0][1]})"
        counted = Counter(how for _, how in deaths)
        hows = ", ".join(how if n == 1 else f"{n} x {how}" for how, n in counted.items())
        return f"died {len(deaths)} times within {self._config.within_s:g} s ({hows})"


def describe(code: int) -> str:
    """An exit code as `subprocess` has it, in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:  # a real-time signal has no name
        return f"signal {-code}"
