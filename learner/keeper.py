"""Checkpoints while learning goes on: copied between two steps, written by a thread beside."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from typing import NamedTuple

from learner import checkpoint
from learner.checkpoint import State
from learner.marks import Record
from learner.replay import Replay
from rtcore.clock import Clock
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop

WAIT_S = 0.2


class _Copy(NamedTuple):
    """A state, and what the replay held when it was made."""

    number: int
    state: State
    record: Record
    last: bool


class Keeper:
    """Writes the checkpoint, never newer than the replay that the disk has: the replay goes first.

    Counts `checkpoints` and `checkpoint.errors`. A replay that the disk has failed has no checkpoints either.
    """

    def __init__(self, directory: Path, period_s: float, clock: Clock, ledger: Ledger) -> None:
        """
        Args:
            directory: of the checkpoint.
            period_s: from one checkpoint to the next.
            clock: of the period.
            ledger: for the counters.
        """
        self._directory = directory
        self.period_ns = round(period_s * 1e9)
        self._clock, self._ledger = clock, ledger
        self._replay: Replay | None = None
        self._due_ns = 0
        self._waiting: Queue[_Copy] = Queue()
        self._writing = threading.Lock()
        self._failed = False
        self._offered = self._done = 0  # numbers of copies

    def meet(self, replay: Replay) -> None:
        """Learn what the states belong to. The first is due at once: a learner that never lives for a period
        gets on all the same."""
        self._replay = replay

    def due(self, now_ns: int) -> bool:
        """Whether `offer` wants a state: it is time, and the one before is on its way to the disk."""
        replay = self._replay
        return (
            now_ns >= self._due_ns and replay is not None and replay.fault is None and self._waiting.empty()
        )

    def offer(self, state: State, now_ns: int) -> None:
        """Take the state as of `now_ns`, a copy; never waits."""
        self._due_ns = now_ns + self.period_ns
        copy = self._copy(state, last=False)
        if copy is not None:
            self._waiting.put(copy)

    def run(self, stop: Stop) -> None:
        """Write until stopped."""
        while not stop.is_set():
            with suppress(Empty):
                self._write(self._waiting.get(timeout=WAIT_S))

    def flush(self) -> None:
        """Write what waits. For any thread."""
        with suppress(Empty):
            while True:
                self._write(self._waiting.get_nowait())

    def finish(self, state: State) -> None:
        """Write the last state, after which nothing is learned."""
        copy = self._copy(state, last=True)
        if copy is not None:
            self._write(copy)

    def _copy(self, state: State, *, last: bool) -> _Copy | None:
        record = None if self._replay is None else self._replay.committed
        self._offered += 1
        return None if record is None else _Copy(self._offered, state, record, last)

    def _write(self, copy: _Copy) -> None:
        with self._writing:
            if copy.number > self._done:
                self._done = copy.number
                self._save(copy)

    def _save(self, copy: _Copy) -> None:
        assert self._replay is not None
        begin_ns = self._clock.now_ns()
        try:
            self._replay.sync(copy.record, last=copy.last)
            checkpoint.save(self._directory, copy.state)
        except OSError as error:  # a full disk, say: the checkpoint before is whole
            self._ledger.count("checkpoint.errors")
            if not self._failed:
                self._ledger.event(self._clock.now_ns(), "WARN", f"no checkpoint: {error}")
            self._failed = True
        else:
            self._failed = False
            self._ledger.count("checkpoints")
            self._ledger.gauge("checkpoint/write_ms", (self._clock.now_ns() - begin_ns) / 1e6)
