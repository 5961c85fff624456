"""A histogram of durations: cheap to record, small on the wire, mergeable, wrong by 1 % at most."""

from __future__ import annotations

import math
from array import array
from itertools import accumulate
from typing import Annotated

import msgspec

# Each octave [2^n, 2^{n+1}) has 2^6 = 64 bins of equal width, so a bin is at most 1/64 of its lower edge
# wide and its middle is off by at most 1/128 < 1 %. Below 128 a bin holds one value.
BITS = 6
BINS_PER_OCTAVE = 1 << BITS
RANGE_MAX = 1 << 40  # 18 minutes in ns; the last bin holds this and all above
VALUE_MAX = (1 << 63) - 1

Natural = Annotated[int, msgspec.Meta(ge=0, le=VALUE_MAX)]
BinCount = Annotated[int, msgspec.Meta(ge=1, le=1 << 53)]  # so that merging a thousand still fits 64 bits


class _Wire(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """The non-empty bins, each as its distance from the one before it and its count."""

    steps: list[Natural]
    counts: list[BinCount]
    min: Natural
    max: Natural
    sum_high: Natural  # sum = sum_high * 2^63 + sum_low
    sum_low: Natural


def _bin(value: int) -> int:
    """The bin of a value in [0, 2^63)."""
    value = min(value, RANGE_MAX)
    shift = max(0, value.bit_length() - BITS - 1)
    return (shift << BITS) + (value >> shift)


def _middle(index: int) -> float:
    """The middle of a bin's integers."""
    if index < 2 * BINS_PER_OCTAVE:
        return float(index)
    shift = (index >> BITS) - 1
    low = (BINS_PER_OCTAVE + index % BINS_PER_OCTAVE) << shift
    return low + ((1 << shift) - 1) / 2


NUM_BINS = _bin(RANGE_MAX) + 1


class Histogram:
    """Non-negative integers, usually ns. One thread records; any thread may read.

    Quantiles are within 1 % up to 2^40; count, sum, min and max are exact (above 2^63 - 1 a value
    counts as that).
    """

    __slots__ = ("_bins", "_max", "_min", "count", "sum")

    def __init__(self) -> None:
        self.count = 0
        self.sum = 0
        self._min = VALUE_MAX
        self._max = -1
        self._bins = array("q", bytes(8 * NUM_BINS))

    def record(self, value: int) -> None:
        """Add one value: 0.2 us, no allocation.

        Raises:
            ValueError: `value` is negative.
        """
        shift = value.bit_length() - 7  # `_bin` written out: a call would cost a third as much again
        if value > self._max:  # before the bins: whoever reads meanwhile finds no value beyond max
            self._max = min(value, VALUE_MAX)
        if value < self._min:
            if value < 0:
                raise ValueError(f"value = {value}: must not be negative")
            self._min = value
        if shift <= 0:
            self._bins[value] += 1
        elif value < RANGE_MAX:
            self._bins[(shift << BITS) + (value >> shift)] += 1
        else:
            value = min(value, VALUE_MAX)
            self._bins[NUM_BINS - 1] += 1
        self.count += 1
        self.sum += value

    @property
    def min(self) -> int | None:
        """The smallest value; None when empty."""
        return self._min if self.count else None

    @property
    def max(self) -> int | None:
        """The largest value; None when empty."""
        return self._max if self.count else None

    def merge(self, other: Histogram) -> None:
        """Add all values of `other`, as if they had been recorded here."""
        self._bins = array("q", map(int.__add__, self._bins, other._bins))
        self._min = min(self._min, other._min)
        self._max = max(self._max, other._max)
        self.count += other.count
        self.sum += other.sum

    def quantile(self, q: float) -> float | None:
        """The smallest value that at least a share q of all values do not exceed; None when empty.

        That is the value of rank ceil(q * count), exact for the first and the last rank, else within
        1 %. Values of 2^40 and more are told apart by the last rank alone.

        Raises:
            ValueError: q is outside [0, 1].
        """
        if not 0.0 <= q <= 1.0:
            raise ValueError(f"q = {q}: must be within [0, 1]")
        if not self.count:
            return None
        rank = math.ceil(q * self.count)
        if rank <= 1:
            return float(self._min)
        if rank >= self.count:
            return float(self._max)
        index = next(i for i, below in enumerate(accumulate(self._bins)) if below >= rank)
        return float(min(max(_middle(index), self._min), self._max))

    def summary(self, scale: float = 1.0) -> dict[str, float | None]:
        """p50, p99, p999 and max, each times `scale` (1e-3: ns to us); None when empty."""
        quantiles = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}
        values = {name: self.quantile(q) for name, q in quantiles.items()}
        return {name: None if value is None else value * scale for name, value in values.items()}

    def to_bytes(self) -> bytes:
        """The histogram as msgpack; 2 to 4 bytes for each non-empty bin."""
        bins = self._bins[:]
        filled = [index for index, count in enumerate(bins) if count]
        sum_high, sum_low = divmod(self.sum, 1 << 63)
        return msgspec.msgpack.encode(
            _Wire(
                steps=[index - before for before, index in zip([0, *filled], filled, strict=False)],
                counts=[bins[index] for index in filled],
                min=self._min,
                max=max(self._max, 0),
                sum_high=sum_high,
                sum_low=sum_low,
            )
        )

    @classmethod
    def from_bytes(cls, data: bytes) -> Histogram:
        """The histogram that `to_bytes` wrote.

        Raises:
            ValueError: the bytes are not one.
        """
        try:
            wire = msgspec.msgpack.decode(data, type=_Wire)
        except msgspec.MsgspecError as error:
            raise ValueError(f"histogram: {error}") from error
        _check(wire)
        histogram = cls()
        for index, count in zip(accumulate(wire.steps), wire.counts, strict=True):
            histogram._bins[index] = count
        if wire.counts:
            histogram._min, histogram._max = wire.min, wire.max
        histogram.count = sum(wire.counts)
        histogram.sum = (wire.sum_high << 63) + wire.sum_low
        return histogram


def _check(wire: _Wire) -> None:
    if len(wire.steps) != len(wire.counts):
        raise ValueError(f"histogram: {len(wire.steps)} bins but {len(wire.counts)} counts")
    if not wire.steps:
        return
    last = sum(wire.steps)
    if 0 in wire.steps[1:] or last >= NUM_BINS:
        raise ValueError(f"histogram: bins must rise and stay below {NUM_BINS}")
    if not (wire.min <= wire.max and _bin(wire.min) <= wire.steps[0] and last <= _bin(wire.max)):
        raise ValueError("histogram: values beyond its own min or max")
