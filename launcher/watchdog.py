"""Who hangs, and who only gets no core. A process that a busy machine starves is not helped by its death: a
start takes more of the core than its loop does.
"""

from __future__ import annotations

from collections.abc import Callable

from launcher.run_delay import RunDelay
from launcher.vitals import Vitals


class Watchdog:
    """Judges the silent ones among a supervisor's children."""

    def __init__(self, vitals: Vitals, pid_of: Callable[[str], int]) -> None:
        """`vitals` are kept informed by others of what is heard; `pid_of` gives a child's number."""
        self._vitals = vitals
        self._pid_of = pid_of
        self._delays: dict[str, RunDelay] = {}  # of the silent ones

    def hung(self, now_ns: int) -> list[str]:
        """Whom to kill. To be called many times a second."""
        self._vitals.look(now_ns)
        silent = self._vitals.silent()
        self._delays = {name: self._delays.get(name) or RunDelay(self._pid_of(name)) for name in silent}
        for name, delay in self._delays.items():
            self._vitals.excuse(name, delay.grown_ns(now_ns))
        return self._vitals.stuck()

    def starving(self) -> list[str]:
        """Who would have been taken for hung but for its waiting; each is named once in a silence."""
        return self._vitals.starving()
