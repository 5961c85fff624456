"""The launcher's own voice: what it saw and did, on the bus and so in the recording, and in its log."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from launcher.restarts import Happening, What
from rtcore import channels
from rtcore.bus import Bus
from rtcore.clock import Clock
from rtcore.ledger import MAX_TEXT, Ledger
from rtcore.log_files import JsonLines, LineFile
from rtcore.messages import Event, Level
from rtcore.process import REPORT_PERIOD_S, Reporter

REPEATED = 64  # a recorder that died too may need a minute to be back, on a busy machine
LEVELS: dict[What, Level] = {
    "died": "WARN",
    "stuck": "WARN",
    "starved": "WARN",
    "restarted": "INFO",
    "gave_up": "ERROR",
}
COUNTERS: dict[What, str] = {
    "died": "deaths",
    "stuck": "hangs",
    "starved": "starvations",
    "restarted": "restarts",
    "gave_up": "given_up",
}


class Herald:
    """Speaks as the process "launcher", once there is something to say: then as often as the others do.

    Counts `deaths`, `hangs`, `starvations`, `restarts` and `given_up`.
    """

    def __init__(self, bus: Bus, clock: Clock, incarnation: int) -> None:
        self._clock = clock
        self._ledger = Ledger(channels.LAUNCHER, incarnation)
        self._reporter = Reporter(self._ledger, bus, clock, channels.LAUNCHER)
        self._told: deque[Event] = deque(maxlen=REPEATED)
        self._due_ns: int | None = None  # None: nothing to say yet

    def tell(self, happening: Happening) -> None:
        """Enter it; `pulse` sends it, and repeats the newest 64 to who was not there to hear them."""
        level = LEVELS[happening.what]
        self._ledger.count(COUNTERS[happening.what])
        self._ledger.event(happening.at_ns, level, happening.text)
        self._told.append(Event(at_ns=happening.at_ns, level=level, text=happening.text[:MAX_TEXT]))
        self._due_ns = self._clock.now_ns()

    def pulse(self) -> None:
        """Send what is due; to be called often. Never waits."""
        now_ns = self._clock.now_ns()
        if self._due_ns is not None and now_ns >= self._due_ns:
            self._due_ns = now_ns + round(REPORT_PERIOD_S * 1e9)
            stats = self._reporter.snapshot()
            self._reporter.publish(msgspec.structs.replace(stats, events=list(self._told)))


@contextmanager
def logged(path: Path) -> Iterator[None]:
    """Inside the block the launcher's events go to `path`; without that, warnings go to stderr, where its
    screen is. A disk that is full costs lines, and nothing else."""
    lines = LineFile(path)  # no file if nothing happens
    lines.setFormatter(JsonLines(channels.LAUNCHER))
    logger = logging.getLogger(channels.LAUNCHER)
    level = logger.level
    logger.setLevel(logging.INFO)
    logger.addHandler(lines)
    try:
        yield
    finally:
        logger.removeHandler(lines)
        lines.close()
        logger.setLevel(level)
