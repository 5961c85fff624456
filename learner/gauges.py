"""The learner's gauges, a few times a second."""

from __future__ import annotations

from collections import deque

from learner.algorithm import Algorithm
from rtcore.ledger import Ledger

PERIOD_NS = 250_000_000


class Gauges:
    """What the newest update saw, and how many of them there are a second."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._due_ns = 0
        self._progress: deque[tuple[int, int]] = deque(maxlen=5)  # (instant, gradient steps)

    def due(self, now_ns: int) -> bool:
        """Whether it is time again."""
        return now_ns >= self._due_ns

    def report(self, algorithm: Algorithm, replay_size: int) -> None:
        """The algorithm's metrics as they are."""
        for name, value in algorithm.metrics().items():
            self._ledger.gauge(name, value)
        self._ledger.gauge("replay_size", replay_size)

    def report_rate(self, now_ns: int) -> None:
        """Gradient steps per second over about the last second."""
        self._due_ns = now_ns + PERIOD_NS
        done = self._ledger.counter("gradient_steps")
        self._progress.append((now_ns, done))
        begin_ns, begun = self._progress[0]
        if now_ns > begin_ns:
            self._ledger.gauge("updates_per_s", (done - begun) * 1e9 / (now_ns - begin_ns))
