"""The lossless log path: the loop appends, another thread sends in batches."""

from __future__ import annotations

import logging
import threading
from collections import deque

from rtcore.bus import Publisher
from rtcore.clock import Clock
from rtcore.ledger import Ledger
from rtcore.lifecycle import RateLimited, Stop
from rtcore.messages import Step, StepBatch

BATCH_STEPS = 50
BATCH_NS = 50_000_000

# A reader that stalls blocks a put for seconds, so steps pile up here meanwhile. 100 000 is 100 s at
# 1 kHz, and 75 MB of HalfCheetah's steps; beyond it the oldest are dropped and counted.
CAPACITY_STEPS = 100_000


class Journal:
    """Every step, in order, in batches of at most 50.

    One thread appends. Any thread may flush, but one at a time.
    """

    def __init__(
        self,
        publisher: Publisher[StepBatch],
        clock: Clock,
        ledger: Ledger,
        *,
        capacity_steps: int = CAPACITY_STEPS,
    ) -> None:
        self._publisher = publisher
        self._clock = clock
        self._ledger = ledger
        self._waiting: deque[Step] = deque(maxlen=capacity_steps)
        self._batch: list[Step] = []  # taken out, not sent yet
        self._sending = threading.Lock()
        self._flushed_ns = 0
        self._complaints = RateLimited(logging.getLogger(__name__), 1.0)
        self._closed = False

    def append(self, step: Step) -> None:
        """Take a step in. Never waits: a full journal drops its oldest step and counts `log.dropped`."""
        if len(self._waiting) == self._waiting.maxlen:
            self._ledger.count("log.dropped")
        self._waiting.append(step)

    def flush(self) -> int:
        """Send everything that waits; may block for seconds when a reader stalls.

        Returns:
            Steps sent.
        """
        with self._sending:
            return self._send_all(last=False)

    def flush_due(self, now_ns: int) -> bool:
        """Flush if 50 steps wait or 50 ms have passed since the last flush; say whether it did."""
        if len(self._waiting) < BATCH_STEPS and now_ns - self._flushed_ns < BATCH_NS:
            return False
        self.flush()
        return True

    def run(self, stop: Stop) -> None:
        """Flush every 50 ms until stopped. A put that fails is counted, and tried again with the next."""
        while not stop.wait(BATCH_NS / 1e9):
            try:
                self.flush()
            except Exception as error:  # noqa: BLE001 - whatever the transport raises, the log must go on
                self._ledger.count("log.errors")
                self._complaints.warning("log path: %s; %d steps wait", error, len(self._waiting))

    def close(self, timeout_s: float = 2.0) -> None:
        """Send what waits and the word that nothing follows. A second close does nothing.

        Args:
            timeout_s: how long to wait for a flush that is blocked on another thread; after it, the
                steps that wait are given up, counted as `log.dropped`.
        """
        if self._closed:
            return
        self._closed = True
        if not self._sending.acquire(timeout=timeout_s):
            self._ledger.count("log.dropped", len(self._waiting))
            self._complaints.error("log path: blocked; %d steps given up", len(self._waiting))
            return
        try:
            self._send_all(last=True)
        finally:
            self._sending.release()

    def _send_all(self, *, last: bool) -> int:
        """Send in batches; the last one says so, even when it is empty. A batch whose put failed is sent
        again: readers drop a repeated step by its `seq`.
        """
        self._flushed_ns = self._clock.now_ns()
        sent = 0
        while True:
            while self._waiting and len(self._batch) < BATCH_STEPS:
                self._batch.append(self._waiting.popleft())
            ending = last and not self._waiting
            if not self._batch and not ending:
                return sent
            self._publisher.put(StepBatch(steps=self._batch, last=ending))
            sent += len(self._batch)
            self._batch = []
            if ending:
                return sent
