"""Tables and verdicts from made-up runs."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks import act_path, arms, deadlines, rtgym_loop
from benchmarks.outcome import Outcome


def outcome(
    *, p50: float = 100.0, p99: float = 200.0, missed: int = 0, pacing: float = 10.0, **more: Any
) -> Outcome:
    return Outcome(
        ticks=10_000,
        missed=missed,
        overruns=0,
        loop_us={"p50": p50, "p99": p99, "p999": 300.0, "max": 400.0},
        pacing_us={"p50": 1.0, "p99": 5.0, "p999": pacing, "max": 2 * pacing},
        stolen_s=0.5,
        more={"updates_per_s": 50.0, "placement": {"env_server": "SCHED_FIFO 50, nice 0"}} | more,
    )


def test_the_loop_may_be_one_and_a_half_raw_echoes_and_must_be_below_the_peers() -> None:
    rows = act_path.summarise(
        {
            "tenuto pointmass": [
                outcome(p50=150, p99=290),
                outcome(p50=150, p99=310),
                outcome(p50=150, p99=320),
            ],
            "raw zenoh": [outcome(p50=100, p99=200)] * 3,
            "raw unix": [outcome(p50=50, p99=60)] * 3,
            "zeromq": [outcome(p50=160, p99=300)] * 3,
        }
    )
    assert [row["tenuto_p99_ratio"] for row in rows] == [
        1.0,
        1.55,
        pytest.approx(310 / 60),
        pytest.approx(31 / 30),
    ]
    assert act_path.verdict(rows) == {
        "raw zenoh p50": True,
        "raw zenoh p99": False,
        "zeromq p50": True,
        "zeromq p99": False,
    }
    assert "tenuto pointmass" in act_path.table(500.0, rows)


def test_what_something_costs_is_the_median_of_the_rounds_ratios() -> None:
    p99 = iter([100.0, 104.0, 110.0, 100.0, 200.0, 212.0])  # without, with; with, without; without, with
    told: list[str] = []

    def measure(arm: str) -> Outcome:
        told.append(arm)
        return outcome(p99=next(p99))

    found = arms.compare(measure, rounds=3)
    assert told == ["without", "with", "with", "without", "without", "with"]
    assert found["ratio_by_round"]["p99"] == [1.04, 1.1, 1.06]
    assert found["ratio"]["p99"] == 1.06
    assert found["within_limit"] is False
    assert "1.040 1.060 1.100" in arms.table("something", found)


@pytest.mark.parametrize(
    ("name", "ours", "bare", "kept"),
    [
        ("100", 0, 0, True),
        ("100", 1, 0, False),
        ("500", 1, 0, True),  # 1e-4
        ("500", 2, 0, False),
        ("500", 12, 10, True),  # the host stalls: 1.2 times the bare pair's
        ("500", 13, 10, False),
        ("1000", 10, 0, True),
        ("1000", 11, 0, False),
        ("500-unprivileged", 10, 0, True),
        ("500-unprivileged", 11, 100, False),  # no excuse there
    ],
)
def test_misses_are_held_against_the_limit_or_the_bare_pair(
    name: str, ours: int, bare: int, kept: bool
) -> None:
    runs = [outcome(missed=missed) for missed in (ours, 10 * ours, 0)]  # the median of three is `ours`
    row = deadlines.judge(deadlines.SETTINGS[name], runs, [outcome(missed=bare)] * 3)
    assert row["miss_ratio"] == ours / 10_000
    assert row["misses_kept"] is kept


def test_pacing_is_held_against_150_us_or_the_bare_pair_only_with_privileges() -> None:
    slow, quick = [outcome(pacing=180.0)], [outcome(pacing=100.0)]
    privileged, ordinary = deadlines.SETTINGS["500"], deadlines.SETTINGS["500-unprivileged"]
    assert deadlines.judge(privileged, slow, quick)["pacing_kept"] is False
    assert deadlines.judge(privileged, slow, [outcome(pacing=160.0)])["pacing_kept"] is True
    assert deadlines.judge(ordinary, slow, quick)["pacing_kept"] is True


def test_a_setting_that_the_system_did_not_grant_is_marked() -> None:
    runs = [outcome()]
    rows = [deadlines.judge(deadlines.SETTINGS[name], runs, runs) for name in ("500", "500-unprivileged")]
    assert [row["as_set"] for row in rows] == [True, False]
    assert "500 Hz, unprivileged (!)" in deadlines.table(rows)


def test_the_fastest_rate_is_the_highest_that_was_held() -> None:
    rates = [
        {"hz": 1000.0, "rows": [rate_row("a", 989.0, 0.0), rate_row("b", 100.0, 0.0)]},
        {"hz": 500.0, "rows": [rate_row("a", 495.0, 0.02), rate_row("b", 100.0, 0.0)]},
        {"hz": 200.0, "rows": [rate_row("a", 200.0, 0.01), rate_row("b", 100.0, 0.0)]},
    ]
    assert rtgym_loop.fastest(rates) == {"a": 500.0, "b": None}
    assert rtgym_loop.fastest(rates, 0.01) == {"a": 200.0, "b": None}


def rate_row(name: str, rate_hz: float, late_share: float) -> dict[str, Any]:
    return {"name": name, "rate_hz": rate_hz, "late_share": late_share}
