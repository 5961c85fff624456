"""Reading the env server's log: the bus's batches as steps in order, each once."""

from __future__ import annotations

from rtcore import channels
from rtcore.bus import Bus
from rtcore.messages import Step
from rtcore.stream import StepStream

PATIENCE_NS = 5_000_000_000  # a missing step is waited for so long; the bus recovers one within 2 s


class LogReader:
    """One reader's place in the log of one environment.

    Attributes:
        stream: its counters tell what came, came twice, and never came.
    """

    def __init__(self, bus: Bus, env: str, *, capacity_batches: int) -> None:
        self._batches = bus.queue(channels.LOG, env, capacity=capacity_batches)
        self._waiting_since_ns: int | None = None  # a step is missing since then
        self.stream = StepStream()

    def go_on_from(self, position: tuple[int, int] | None) -> None:
        """Begin at this (incarnation, seq), where an earlier reader ended. Call it before reading."""
        self.stream = StepStream(position)

    @property
    def ended(self) -> bool:
        """Whether the env server ended in order and everything before its end was read."""
        return self.stream.ended

    def wait(self, timeout_s: float) -> None:
        """Wait until something has come, at most so long."""
        self._batches.wait(timeout_s)

    def read(self, now_ns: int) -> list[Step]:
        """New steps; those behind a missing one come when it does, or 5 s later without it."""
        steps: list[Step] = []
        for received in self._batches.drain():
            steps += self.stream.feed(received.message)
        if not self.stream.waiting:
            self._waiting_since_ns = None
        elif self._waiting_since_ns is None or steps:
            self._waiting_since_ns = now_ns
        elif now_ns - self._waiting_since_ns >= PATIENCE_NS:
            self._waiting_since_ns = now_ns
            steps += self.stream.give_up()
        return steps

    def finish(self) -> list[Step]:
        """Nothing follows: give up on what is missing, and return what waited behind it."""
        return self.stream.flush()
