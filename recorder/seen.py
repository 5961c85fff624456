"""What has been taken from a source that repeats itself. Pure, bounded, and short enough to write down."""

from __future__ import annotations

from bisect import insort

import msgspec

KEPT = 4096  # window notices in one message of the learner, which repeats the most
MARKED = 256  # events in one message
EVENTS_KEPT = 512  # of one process, which repeats 256 at most
STATS_KEPT = STATS_MARKED = 16  # of one process, which repeats none: four seconds of disorder
_NEVER_NS = -(1 << 63)


class SeenMark(msgspec.Struct, frozen=True, array_like=True):
    """A `Seen` as it is written down: the newest items, and the stamp up to which the others lie."""

    floor_ns: int = _NEVER_NS
    items: list[tuple[int, int]] = []


class Seen:
    """Items named by their stamp and a number that tells those of one stamp apart.

    The newest `kept` at least are remembered one by one, less than twice as many; what is not newer than a
    forgotten one counts as seen. `marked` are written down.
    """

    def __init__(self, mark: SeenMark | None = None, *, kept: int = KEPT, marked: int = MARKED) -> None:
        self._kept, self._marked = kept, marked
        self._begin(mark or SeenMark())

    def add(self, at_ns: int, number: int) -> bool:
        """Take an item; says whether it is new."""
        item = (at_ns, number)
        if at_ns <= self._floor_ns or item in self._items:
            return False
        self._items.add(item)
        insort(self._sorted, item)  # nearly always the last
        if len(self._sorted) >= 2 * self._kept:
            self._begin(self._newest(self._kept))
        return True

    def mark(self) -> SeenMark:
        """The newest items, 256 unless told otherwise, to go on from."""
        return self._newest(self._marked)

    def _begin(self, mark: SeenMark) -> None:
        self._floor_ns = mark.floor_ns
        self._items = set(mark.items)
        self._sorted = sorted(self._items)

    def _newest(self, n: int) -> SeenMark:
        forgotten = len(self._sorted) - n
        floor_ns = self._sorted[forgotten - 1][0] if forgotten > 0 else self._floor_ns
        return SeenMark(floor_ns, self._sorted[-n:])
