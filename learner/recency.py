"""Which transitions to draw when the newer ones shall come more often. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Units = NDArray[np.int32]
Whole = NDArray[np.int64]


def unit_ages(uniform: NDArray[np.float64], mean: float, span: int) -> Whole:
    """Whole ages 0 .. `span` - 1 by inversion of the exponential distribution, cut off at `span`.

    Age k comes with probability exp(-k / mean) (1 - exp(-1 / mean)) / (1 - exp(-span / mean)).

    Args:
        uniform: in [0, 1).
        mean: in units, before the cut.
        span: in units, >= 1.
    """
    ages: NDArray[np.float64] = -mean * np.log1p(uniform * np.expm1(-span / mean))
    return np.minimum(ages.astype(np.int64), np.int64(span - 1))  # rounding may reach `span`


class RecentUnits:
    """The newest transitions of a ring, found by the age of their unit.

    Ages count from the newest whole unit. The one under way is part of it: with a unit of its own, its
    first transition would fill most of a batch. A unit without transitions gives its share to the next
    older one that has some.
    """

    def __init__(self, older: Units, newer: Units, count: int) -> None:
        """
        Args:
            older: units of the transitions in the ring's end, rising; empty until it is full.
            newer: units of those from its beginning on, rising, all >= those in `older`; not empty.
            count: how many of the newest there are to draw from, >= 1.
        """
        self._older, self._newer, self._count = older, newer, count
        self._skipped = len(older) + len(newer) - count
        newest = int(newer[-1])
        self._oldest = int(self._units(np.array([0]))[0])
        self._base = max(newest - 1, self._oldest)  # of age 0
        self._span = self._base - self._oldest + 1

    def rows(self, uniform: NDArray[np.float64], mean: float) -> Whole:
        """Transitions drawn by age, 0 the oldest of `count`.

        Args:
            uniform: [2, B], in [0, 1): for the age, and for the place within the unit.
            mean: of the ages, in units.

        Returns:
            [B].
        """
        begin, end = self._within(self._base - unit_ages(uniform[0], mean, self._span))
        found: Whole = begin + (uniform[1] * (end - begin)).astype(np.int64)
        return found

    def mean_unit(self, mean: float) -> float:
        """Of the transitions that `rows` draws."""
        unit = np.arange(self._oldest, self._base + 1)
        share = np.exp((unit - self._base) / mean)
        begin, end = self._within(unit)
        units = self._units(begin).astype(np.float64)
        units[-1] = self._units(np.arange(begin[-1], end[-1])).mean()  # two units, it may be
        return float(share @ units / share.sum())

    def _within(self, unit: Whole) -> tuple[Whole, Whole]:
        """The first transition of each unit, or of the one that stands for it, and the first one after."""
        end = np.where(unit < self._base, self._begin(unit + 1), self._count)
        return self._begin(np.minimum(unit, self._units(end - 1))), end

    def _begin(self, unit: NDArray[np.integer]) -> Whole:
        """How many transitions are older than each unit."""
        sought = unit.astype(np.int32)  # of the column's type: for any other, the column would be converted
        older = np.searchsorted(self._older, sought) + np.searchsorted(self._newer, sought)
        begin: Whole = np.maximum(older - self._skipped, 0)
        return begin

    def _units(self, row: Whole) -> Units:
        """The unit of each transition, 0 the oldest of `count`."""
        row = row + self._skipped
        newer = np.take(self._newer, row - len(self._older), mode="clip")
        if not len(self._older):
            return newer
        return np.where(row < len(self._older), np.take(self._older, row, mode="clip"), newer)
