from __future__ import annotations

from benchmarks.outcome import Outcome, median, ratios, share_above, turns
from rtcore.histogram import Histogram


def outcome(p50: float | None, *, missed: int = 0, ticks: int = 100) -> Outcome:
    quantiles = {"p50": p50, "p99": None, "p999": None, "max": None}
    return Outcome(ticks=ticks, missed=missed, overruns=0, loop_us=quantiles, pacing_us=quantiles)


def test_contenders_take_turns_and_each_round_begins_one_further_on() -> None:
    assert list(turns(("a", "b", "c"), 2)) == [(0, "a"), (0, "b"), (0, "c"), (1, "b"), (1, "c"), (1, "a")]


def test_a_ratio_is_one_rounds_and_what_was_not_measured_has_none() -> None:
    ours = [outcome(30.0), outcome(40.0), outcome(None), outcome(1.0)]
    theirs = [outcome(20.0), outcome(10.0), outcome(5.0), outcome(None)]
    assert ratios(ours, theirs, "p50") == [1.5, 4.0]


def test_the_median_is_of_what_was_measured() -> None:
    assert median([3.0, None, 1.0, 2.0]) == 2.0
    assert median([None]) is None


def test_the_share_above_a_threshold_is_exact_where_the_bins_are() -> None:
    histogram = Histogram()
    assert share_above(histogram, 5) == 0.0
    for value in (1, 2, 3, 50):
        histogram.record(value)
    assert share_above(histogram, 0) == 1.0
    assert share_above(histogram, 1) == 0.75
    assert share_above(histogram, 3) == 0.25
    assert share_above(histogram, 49) == 0.25
    assert share_above(histogram, 50) == 0.0


def test_an_outcome_survives_the_way_through_json() -> None:
    before = outcome(2.0, missed=3)
    assert before.as_dict()["miss_ratio"] == 0.03
    assert Outcome.read(before.as_dict()) == before


def test_a_run_without_a_tick_missed_everything() -> None:
    assert outcome(None, ticks=0).miss_ratio == 1.0
