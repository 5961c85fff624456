"""Steal time: how long this machine's processors were taken away by the host that it is a guest of."""

from __future__ import annotations

import os
from pathlib import Path

PROC_STAT = Path("/proc/stat")
STEAL_FIELD = 8  # of the line "cpu user nice system idle iowait irq softirq steal ..."; see proc_stat(5)


def steal_s(text: str, ticks_per_s: int) -> float | None:
    """Seconds of steal since boot, over all processors, from the text of /proc/stat; None if it has none."""
    fields = text.partition("\n")[0].split()
    if len(fields) <= STEAL_FIELD or fields[0] != "cpu":
        return None
    return int(fields[STEAL_FIELD]) / ticks_per_s


class StealMeter:
    """Steal since it was made. The system counts in steps of 10 ms."""

    def __init__(self) -> None:
        self._before_s = _read_s()

    def elapsed_s(self) -> float | None:
        """Seconds over all processors; None where the system does not tell."""
        now_s = _read_s()
        return None if now_s is None or self._before_s is None else now_s - self._before_s


def _read_s() -> float | None:
    return steal_s(PROC_STAT.read_text(), os.sysconf("SC_CLK_TCK")) if PROC_STAT.exists() else None
