"""The histogram against numpy and against counting by hand."""

from __future__ import annotations

import time
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcore.histogram import NUM_BINS, RANGE_MAX, VALUE_MAX, Histogram, _bin, _middle

VALUES = st.lists(
    st.integers(0, 200)
    | st.integers(0, RANGE_MAX - 1)
    | st.integers(0, 40).flatmap(lambda n: st.integers(0, min(2**n + 1, RANGE_MAX - 1))),
    min_size=1,
    max_size=200,
)


def of(values: list[int]) -> Histogram:
    histogram = Histogram()
    for value in values:
        histogram.record(value)
    return histogram


def contents(histogram: Histogram) -> tuple[object, ...]:
    return (
        list(histogram._bins),
        histogram.count,
        histogram.sum,
        histogram.min,
        histogram.max,
    )


def test_empty() -> None:
    histogram = Histogram()
    assert (histogram.count, histogram.sum, histogram.min, histogram.max) == (0, 0, None, None)
    assert histogram.quantile(0.5) is None
    assert histogram.summary() == {"p50": None, "p99": None, "p999": None, "max": None}
    assert contents(Histogram.from_bytes(histogram.to_bytes())) == contents(histogram)


def test_small_values_are_exact() -> None:
    histogram = of([3, 0, 127, 3, 64])
    assert (histogram.count, histogram.sum, histogram.min, histogram.max) == (5, 197, 0, 127)
    assert [histogram.quantile(q) for q in (0, 0.2, 0.21, 0.6, 0.61, 0.8, 0.81, 1)] == [
        0,
        0,
        3,
        3,
        64,
        64,
        127,
        127,
    ]


def test_the_first_and_the_last_rank_are_exact() -> None:
    histogram = of([1_000_001, 5_000_000, 9_000_001])
    assert histogram.quantile(0.33) == 1_000_001
    assert histogram.quantile(0.67) == 9_000_001
    assert histogram.quantile(0.5) == pytest.approx(5_000_000, rel=0.01)


def test_bins_by_hand() -> None:
    # 128 = 2^7: bins of 2 from there, so 128 and 129 share one whose middle is 128.5; 130 starts the next.
    assert _bin(127) == 127
    assert _bin(128) == _bin(129) == 128
    assert _bin(130) == 129
    assert _middle(128) == 128.5
    # 2^20: bins of 2^14 = 16384.
    assert _bin(2**20) == _bin(2**20 + 16383) == _bin(2**20 + 16384) - 1
    assert _middle(_bin(2**20)) == 2**20 + 16383 / 2
    assert _bin(RANGE_MAX) == _bin(VALUE_MAX) == NUM_BINS - 1


def test_bins_follow_each_other_without_gaps() -> None:
    edges = {2**n + d for n in range(41) for d in (-1, 0, 1)} | set(range(5000))
    values = sorted(edge for edge in edges if edge <= RANGE_MAX)
    steps = [_bin(b) - _bin(a) for a, b in pairwise(values) if b - a == 1]
    assert set(steps) <= {0, 1}


@given(VALUES, st.sampled_from([0.0, 0.25, 0.5, 0.75, 0.9, 0.99, 0.999, 1.0]))
def test_quantiles_are_numpys_within_one_per_cent(values: list[int], q: float) -> None:
    exact = float(np.quantile(np.array(values, dtype=np.float64), q, method="inverted_cdf"))
    assert of(values).quantile(q) == pytest.approx(exact, rel=0.01, abs=0)


def test_quantiles_of_many_values_are_numpys_within_one_per_cent() -> None:
    values = np.random.default_rng(1).lognormal(11, 2, 20_000).astype(np.int64)
    histogram = of(values.tolist())
    for q in (0.001, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 0.9999):
        assert histogram.quantile(q) == pytest.approx(
            float(np.quantile(values, q)), rel=0.03 if q > 0.999 else 0.01
        )
    assert histogram.quantile(1) == values.max()


@given(VALUES)
def test_count_sum_min_and_max_are_exact(values: list[int]) -> None:
    histogram = of(values)
    assert (histogram.count, histogram.sum) == (len(values), sum(values))
    assert (histogram.min, histogram.max) == (min(values), max(values))
    assert (histogram.quantile(0), histogram.quantile(1)) == (min(values), max(values))


@given(VALUES, VALUES)
def test_merging_is_recording_all_in_one(values: list[int], others: list[int]) -> None:
    merged = of(values)
    merged.merge(of(others))
    merged.merge(Histogram())
    assert contents(merged) == contents(of(values + others))
    empty = Histogram()
    empty.merge(of(values))
    assert contents(empty) == contents(of(values))


@given(VALUES)
def test_the_wire_keeps_everything(values: list[int]) -> None:
    histogram = of(values)
    data = histogram.to_bytes()
    assert contents(Histogram.from_bytes(data)) == contents(histogram)
    assert len(data) <= 60 + 4 * len(set(values))


def test_the_wire_is_compact() -> None:
    assert len(Histogram().to_bytes()) <= 16
    values = np.random.default_rng(2).normal(180_000, 20_000, 5_000).astype(np.int64)
    assert len(of(values.tolist()).to_bytes()) < 400


@given(st.binary(max_size=60))
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="histogram"):
        Histogram.from_bytes(data)


@pytest.mark.parametrize(
    ("wire", "reason"),
    [
        ([[5], [1, 1], 5, 5, 0, 5], "1 bins but 2 counts"),
        ([[5, 0], [1, 1], 5, 5, 0, 10], "must rise"),
        ([[NUM_BINS], [1], 5, 5, 0, 5], "must rise and stay below"),
        ([[5], [1], 6, 6, 0, 5], "beyond its own min or max"),
        ([[5, 3], [1, 1], 5, 7, 0, 13], "beyond its own min or max"),
        ([[128], [1], 129, 128, 0, 129], "beyond its own min or max"),
        ([[5], [0], 5, 5, 0, 5], "counts|Expected"),
        ([[-5], [1], 5, 5, 0, 5], "Expected"),
        ([[5], [2**60], 5, 5, 0, 5], "Expected"),
    ],
)
def test_histograms_that_contradict_themselves_are_refused(wire: list[object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Histogram.from_bytes(msgspec.msgpack.encode(wire))


def test_a_negative_value_is_refused_and_leaves_no_trace() -> None:
    histogram = of([4])
    with pytest.raises(ValueError, match="value = -3: must not be negative"):
        histogram.record(-3)
    assert contents(histogram) == contents(of([4]))


def test_values_beyond_the_range_keep_their_max_and_sum() -> None:
    histogram = of([1, RANGE_MAX, RANGE_MAX * 2, RANGE_MAX * 5])
    assert histogram.max == RANGE_MAX * 5
    assert histogram.sum == 8 * RANGE_MAX + 1
    assert histogram.quantile(0.5) == pytest.approx(RANGE_MAX, rel=0.01)
    histogram.record(1 << 80)
    assert histogram.max == VALUE_MAX
    assert contents(Histogram.from_bytes(histogram.to_bytes())) == contents(histogram)


def test_summary_scales() -> None:
    assert of([1000] * 1000 + [9_000_000]).summary(1e-3) == {
        "p50": pytest.approx(1.0, rel=0.01),
        "p99": pytest.approx(1.0, rel=0.01),
        "p999": pytest.approx(1.0, rel=0.01),
        "max": 9000.0,
    }


def test_recording_is_fast() -> None:
    values = np.random.default_rng(3).lognormal(11, 2, 5_000).astype(np.int64).tolist()
    record = Histogram().record
    best_ns = min(_time_ns(record, values) for _ in range(10)) / len(values)
    assert best_ns < 1500


def _time_ns(record: object, values: list[int]) -> int:
    assert callable(record)
    began = time.perf_counter_ns()
    for value in values:
        record(value)
    return time.perf_counter_ns() - began
