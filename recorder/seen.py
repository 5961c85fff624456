"""What has been taken from a source that repeats itself. Pure, bounded, and short enough to write down."""

from __future__ import annotations

from bisect import insort

import msgspec

KEPT = 4096  # window notices in one message of the learner, which repeats the most
MARKED = 256  # events in one message
_NEVER_NS = -(1 << 63)


class SeenMark(msgspec.Struct, frozen=True, array_like=True):
    """A `Seen` as it is written down: the newest items, and the stamp up to which the others lie."""

    floor_ns: int = _NEVER_NS
    items: list[tuple[int, int]] = []


class Seen:
    """Items named by their stamp and a number that tells those of one stamp apart.

    The newest 4096 at least are remembered one by one; what is not newer than a forgotten one counts as seen.
    """

    def __init__(self, mark: SeenMark | None = None) -> None:
        self._begin(mark or SeenMark())

    def add(self, at_ns: int, number: int) -> bool:
        """Take an item; says whether it is new."""
        item = (at_ns, number)
        if at_ns <= self._floor_ns or item in self._items:
            return False
        self._items.add(item)
        insort(self._sorted, item)  # nearly always the last
        if len(self._sorted) == 2 * KEPT:
            self._begin(self._newest(KEPT))
        return True

    def mark(self) -> SeenMark:
        """The newest 256 items, to go on from."""
        return self._newest(MARKED)

    def _begin(self, mark: SeenMark) -> None:
        self._floor_ns = mark.floor_ns
        self._items = set(mark.items)
        self._sorted = sorted(self._items)

    def _newest(self, n: int) -> SeenMark:
        forgotten = len(self._sorted) - n
        floor_ns = self._sorted[forgotten - 1][0] if forgotten > 0 else self._floor_ns
        return SeenMark(floor_ns, self._sorted[-n:])
