"""Ticks at absolute deadlines, and the rule for the deadlines that were slept or worked through."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rtcore.clock import Clock
from rtcore.config import ConfigError
from rtcore.lifecycle import Stop

SLICE_NS = 200_000_000  # a stop interrupts a wait of any length after no more than this


@dataclass(frozen=True, slots=True)
class Tick:
    """One executed deadline."""

    index: int  # k
    due_ns: int  # D_k = t0 + k * period
    woke_ns: int  # when the tick really began, >= due_ns
    skipped: int  # deadlines lost right before this one


class Pacer:
    """Yields ticks k = 0, 1, 2, ... at D_k = t0_ns + k * period_ns.

    Deadlines are absolute: a late tick delays no other. Overrun: if the pacer wakes for tick k at or
    after D_{k+1}, the ticks before the latest D_j <= now are skipped and counted, never run back to
    back, and the phase stays. If D_j is at `end_index` or beyond, the ticks up to the end are lost
    and none follows, so without a stop `executed + skipped_total == end_index - first_index`.

    Attributes:
        executed: ticks yielded.
        overruns: times that one or more deadlines were lost.
        skipped_total: deadlines lost.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        t0_ns: int,
        period_ns: int,
        first_index: int = 0,
        end_index: int | None = None,
        beat: Callable[[int], None] | None = None,
    ) -> None:
        """Args:
        clock: waited on.
        t0_ns: D_0, which may have passed long ago.
        period_ns: from one deadline to the next.
        first_index: the first tick; those before it are somebody else's.
        end_index: the tick after the last; None: without end.
        beat: called with the instant at least once per tick, and every 200 ms of a wait.
        """
        if period_ns <= 0:
            raise ConfigError("period_ns", period_ns, "must be a positive number of nanoseconds")
        self._clock = clock
        self._t0_ns = t0_ns
        self._period_ns = period_ns
        self._end_index = end_index
        self._next_index = first_index
        self._beat = beat
        self.executed = 0
        self.overruns = 0
        self.skipped_total = 0

    def ticks(self, stop: Stop) -> Iterator[Tick]:
        """Ticks until `stop` is set or `end_index` is reached. A second call goes on from there."""
        while not self._ended() and self._wait(self._due_ns(self._next_index), stop):
            woke_ns = self._clock.now_ns()
            skipped = self._skip(woke_ns)
            if self._ended():
                return
            index = self._next_index
            self._next_index += 1
            self.executed += 1
            yield Tick(index, self._due_ns(index), woke_ns, skipped)

    def _due_ns(self, index: int) -> int:
        return self._t0_ns + index * self._period_ns

    def _ended(self) -> bool:
        return self._end_index is not None and self._next_index >= self._end_index

    def _wait(self, due_ns: int, stop: Stop) -> bool:
        """Sleep until `due_ns` in equal slices; False as soon as a stop is seen.

        Equal, because a short last slice after a long one would spin too short a tail.
        """
        while not stop.is_set():
            now_ns = self._clock.now_ns()
            if self._beat is not None:
                self._beat(now_ns)
            remaining_ns = due_ns - now_ns
            if remaining_ns <= 0:
                return True
            slices = -(-remaining_ns // SLICE_NS)
            self._clock.sleep_until_ns(now_ns + remaining_ns // slices)
        return False

    def _skip(self, now_ns: int) -> int:
        """Move on to the latest deadline that has passed; the number of deadlines given up."""
        latest = (now_ns - self._t0_ns) // self._period_ns
        if self._end_index is not None:
            latest = min(latest, self._end_index)
        skipped = latest - self._next_index
        self._next_index = latest
        self.skipped_total += skipped
        self.overruns += skipped > 0
        return skipped
