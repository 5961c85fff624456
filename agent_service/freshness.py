"""Which observations are still worth an answer. Pure."""

from __future__ import annotations

OLD_TICKS = 2  # older than this on arrival, an observation's answer is late whatever the agent does
OLD_IN_A_ROW = 256  # a backlog of a quarter of a second at 1 kHz; beyond it the stamps are not believed
MEMORY = 1000  # observations over which the shortest way is remembered


class Freshness:
    """Tells the backlog behind a stall from observations that came straight.

    After a stall every observation that waited arrives, oldest first. Answering them all would keep the
    newest waiting: 5 ms after a stall of 50 ms at 1 kHz. The two stamps may come from the clocks of two
    hosts, so an age is the excess over the shortest way of the last 1000 to 2000 observations; clocks that
    drift apart by 100 ppm move that by 0.2 of a tick at most.
    """

    def __init__(self, tick_ns: int) -> None:
        self._limit_ns = OLD_TICKS * tick_ns
        self._shortest_ns: int | None = None
        self._next_shortest_ns: int | None = None  # of the 1000 under way
        self._seen = 0
        self._in_a_row = 0

    def is_old(self, sent_ns: int, received_ns: int) -> bool:
        """Whether the observation waited for more than two ticks longer than others do."""
        way_ns = received_ns - sent_ns
        if self._next_shortest_ns is None or way_ns < self._next_shortest_ns:
            self._next_shortest_ns = way_ns
        if self._shortest_ns is None or way_ns < self._shortest_ns:
            self._shortest_ns = way_ns
        self._seen += 1
        if self._seen == MEMORY:
            self._shortest_ns, self._next_shortest_ns, self._seen = self._next_shortest_ns, None, 0
        old = way_ns - self._shortest_ns > self._limit_ns
        self._in_a_row = self._in_a_row + 1 if old else 0
        if self._in_a_row == OLD_IN_A_ROW:  # no backlog is as long: a clock was set
            self._shortest_ns = self._next_shortest_ns = way_ns
        return old
