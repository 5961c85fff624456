from __future__ import annotations

from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcore.config import ConfigError, Rounding, ScheduleConfig
from rtcore.windows import (
    ExplicitSchedule,
    FixedSchedule,
    Position,
    Window,
    WindowClock,
    make_schedule,
    update_units,
)

SECOND = 1_000_000_000
PAPER = ExplicitSchedule((0, 13, 25), (10, 4, 5))

# By hand from l_f * gamma_f, gamma_f = .1, .2, .., 1. `floor` and `paper_le` are also the table of the notes.
COUNTS: dict[tuple[int, Rounding], list[int]] = {
    (5, "floor"): [1, 1, 1, 2, 2, 3, 3, 4, 4, 5],
    (5, "ceil"): [1, 1, 2, 2, 3, 3, 4, 4, 5, 5],
    (5, "paper_le"): [1, 2, 2, 3, 3, 4, 4, 5, 5, 5],
    (15, "floor"): [1, 3, 4, 6, 7, 9, 10, 12, 13, 15],
    (15, "ceil"): [2, 3, 5, 6, 8, 9, 11, 12, 14, 15],
    (15, "paper_le"): [2, 4, 5, 7, 8, 10, 11, 13, 14, 15],
    (20, "floor"): [2, 4, 6, 8, 10, 12, 14, 16, 18, 20],
    (20, "ceil"): [2, 4, 6, 8, 10, 12, 14, 16, 18, 20],
    (20, "paper_le"): [3, 5, 7, 9, 11, 13, 15, 17, 19, 20],
}


@pytest.mark.parametrize(("l_f", "rounding"), COUNTS)
def test_update_counts_over_gamma_f(l_f: int, rounding: Rounding) -> None:
    assert [update_units(l_f, g / 10, rounding) for g in range(1, 11)] == COUNTS[l_f, rounding]


def test_the_product_may_land_beside_its_integer() -> None:
    assert 3 * 0.1 > 0.3  # the rounding error that the tolerance is for
    assert update_units(30, 0.1 + 0.2, "ceil") == 9
    assert update_units(10, 0.7, "floor") == 7
    assert update_units(100, 0.29, "floor") == 29  # 100 * .29 = 28.999999999999996
    assert update_units(100, 0.29, "paper_le") == 30
    assert update_units(100, 0.28, "ceil") == 28  # 100 * .28 = 28.000000000000004


def test_a_window_is_never_without_update_nor_longer_than_itself() -> None:
    for rounding in get_args(Rounding):
        assert update_units(5, 0.01, rounding) == 1
        assert update_units(5, 1.0, rounding) == 5
        assert update_units(1, 0.5, rounding) == 1


def test_fixed_windows() -> None:
    schedule = FixedSchedule(10, 0.7)
    assert schedule.window_at(0) == Window(0, 0, 7, 3)
    assert schedule.window_at(9) == Window(0, 0, 7, 3)
    assert schedule.window_at(10) == Window(1, 10, 7, 3)
    assert schedule.window_at(10**15 + 3) == Window(10**14, 10**15, 7, 3)
    assert schedule.window_at(25).end == 30
    assert FixedSchedule(10, 1.0).window_at(3) == Window(0, 0, 10, 0)


def test_explicit_windows_are_the_papers_example() -> None:
    windows = [Window(0, 0, 10, 3), Window(1, 13, 4, 8), Window(2, 25, 5, None)]
    ends = [0] * 13 + [1] * 12 + [2] * 30
    assert [PAPER.window_at(t) for t in range(55)] == [windows[m] for m in ends]
    assert [w.end for w in windows] == [13, 25, None]


def test_the_papers_policies_over_time() -> None:
    """Section 3's example: pi^1..pi^10 act at t = 1..10, pi^10 at 11..13, then pi^1..pi^4 at 14..17,
    pi^4 at 18..25, and pi^1..pi^5 from 26 on. The iterate due at the end of unit t-1 acts at t."""
    clock = WindowClock(PAPER, SECOND)
    acting = []
    for t in range(1, 33):
        before = clock.position((t - 1) * SECOND)
        acting.append((before.window.m, before.iterate))
    expected = [(0, g) for g in range(1, 11)] + [(0, 10)] * 3
    expected += [(1, g) for g in range(1, 5)] + [(1, 4)] * 8
    expected += [(2, g) for g in range(1, 6)] + [(2, 5)] * 2
    assert acting == expected


def test_positions_at_the_papers_boundaries() -> None:
    clock = WindowClock(PAPER, SECOND)
    first, second, last = Window(0, 0, 10, 3), Window(1, 13, 4, 8), Window(2, 25, 5, None)
    s = SECOND
    cases = {
        0: Position(first, 0, 1, "update", 0, 10 * s, s),
        s - 1: Position(first, 0, 1, "update", 0, 10 * s, s),
        s: Position(first, 1, 2, "update", 0, 10 * s, 2 * s),
        10 * s - 1: Position(first, 9, 10, "update", 0, 10 * s, 10 * s),
        10 * s: Position(first, 10, 10, "hold", 10 * s, 13 * s, 11 * s),
        13 * s - 1: Position(first, 12, 10, "hold", 10 * s, 13 * s, 13 * s),
        13 * s: Position(second, 13, 1, "update", 13 * s, 17 * s, 14 * s),
        17 * s: Position(second, 17, 4, "hold", 17 * s, 25 * s, 18 * s),
        25 * s: Position(last, 25, 1, "update", 25 * s, 30 * s, 26 * s),
        30 * s: Position(last, 30, 5, "hold", 30 * s, None, 31 * s),
        10**6 * s: Position(last, 10**6, 5, "hold", 30 * s, None, (10**6 + 1) * s),
    }
    for run_time_ns, expected in cases.items():
        assert clock.position(run_time_ns) == expected


def test_boundaries_are_exact_where_floats_are_not() -> None:
    unit_ns = 333_333_333
    clock = WindowClock(FixedSchedule(10, 0.7), unit_ns)
    t = 10**9 + 7  # run time ~ 3.3e17 ns: a float64 resolves 64 ns there
    assert clock.position(t * unit_ns - 1).phase == "update"
    assert clock.position(t * unit_ns).phase == "hold"
    assert clock.position((t + 3) * unit_ns - 1).phase == "hold"
    assert clock.position((t + 3) * unit_ns).phase == "update"


def test_without_hold_updates_follow_each_other() -> None:
    clock = WindowClock(FixedSchedule(3, 1.0), 10)
    assert [clock.position(ns).phase for ns in range(0, 90, 10)] == ["update"] * 9
    assert [clock.position(ns).iterate for ns in range(0, 90, 10)] == [1, 2, 3] * 3
    assert clock.position(29).phase_end_ns == 30


def test_time_before_the_run_is_refused() -> None:
    with pytest.raises(ValueError, match="run_time_ns = -1"):
        WindowClock(PAPER, SECOND).position(-1)
    with pytest.raises(ValueError, match="unit_ns = 0"):
        WindowClock(PAPER, 0)
    for schedule in (PAPER, FixedSchedule(5, 0.5)):
        with pytest.raises(ValueError, match="t = -1"):
            schedule.window_at(-1)


@pytest.mark.parametrize(
    ("t_m", "g_m", "message"),
    [
        ((), (), "learner.schedule.t_m = (): must list at least one window start"),
        ((1, 5), (2, 2), "learner.schedule.t_m = (1, 5): must start with 0"),
        ((0, 5, 5), (2, 2, 2), "learner.schedule.t_m = (0, 5, 5): must rise"),
        ((0, 6, 5), (2, 2, 2), "learner.schedule.t_m = (0, 6, 5): must rise"),
        (
            (0, 5),
            (2,),
            "learner.schedule.g_m = (2,): must have one entry for each of the 2 window starts t_m",
        ),
        ((0, 5), (0, 2), "learner.schedule.g_m = (0, 2): must be >= 1 each"),
        (
            (0, 13, 25),
            (10, 13, 5),
            "learner.schedule.g_m = (10, 13, 5): entry 1 must be <= 12, the length of window [13, 25)",
        ),
    ],
)
def test_wrong_lists_are_refused(t_m: tuple[int, ...], g_m: tuple[int, ...], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        make_schedule(ScheduleConfig(kind="explicit", t_m=t_m, g_m=g_m))
    assert str(error.value) == message


def test_a_window_may_be_updated_to_its_very_end() -> None:
    assert ExplicitSchedule((0, 5), (5, 1)).window_at(4) == Window(0, 0, 5, 0)


def test_wrong_fixed_values_are_refused() -> None:
    for gamma_f in (0.0, -0.1, 1.0001, float("nan")):
        with pytest.raises(ConfigError, match=r"learner\.schedule\.gamma_f = .*: must be in \(0, 1\]"):
            FixedSchedule(5, gamma_f)
    with pytest.raises(ConfigError, match=r"learner\.schedule\.l_f = 0: must be an integer >= 1"):
        FixedSchedule(0, 0.5)
    with pytest.raises(ConfigError, match=r"learner\.schedule\.rounding = 'up'"):
        FixedSchedule(5, 0.5, "up")  # type: ignore[arg-type]


@given(
    l_f=st.integers(1, 60),
    gamma_f=st.floats(0.001, 1.0),
    rounding=st.sampled_from(get_args(Rounding)),
    t=st.integers(0, 10**6),
    unit_ns=st.integers(1, 10**10),
    data=st.data(),
)
def test_every_instant_has_one_place(
    l_f: int, gamma_f: float, rounding: Rounding, t: int, unit_ns: int, data: st.DataObject
) -> None:
    position = WindowClock(FixedSchedule(l_f, gamma_f, rounding), unit_ns).position(
        t * unit_ns + data.draw(st.integers(0, unit_ns - 1))
    )
    window = position.window
    assert position.unit == t and window.end is not None and window.hold is not None
    assert window.start <= t < window.end == window.start + l_f
    assert window.update + window.hold == l_f and 1 <= position.iterate <= window.update
    assert position.phase == ("update" if t < window.start + window.update else "hold")
    assert position.phase_end_ns is not None
    assert position.phase_start_ns <= t * unit_ns < position.unit_end_ns <= position.phase_end_ns
