"""The conductor against hand-written schedules: what is due, when, and never in a hold."""

from __future__ import annotations

from learner.conductor import (
    Conductor,
    Happening,
    PhaseEntered,
    PublishDue,
    PublishMissed,
    UnitEnded,
    WindowEntered,
)
from rtcore.windows import ExplicitSchedule, FixedSchedule, Window, WindowClock

UNIT_NS = 1_000
LEAD_NS = 100


def walk(conductor: Conductor, instants: list[int]) -> list[list[Happening]]:
    return [list(conductor.advance(instant, LEAD_NS)) for instant in instants]


def improves(conductor: Conductor) -> bool:
    return conductor.improving


def conductor_3_2() -> Conductor:
    """Windows of 5 units: 3 update, 2 hold."""
    return Conductor(WindowClock(FixedSchedule(l_f=5, gamma_f=0.6, rounding="floor"), UNIT_NS))


def test_one_window_from_its_start_to_the_next() -> None:
    conductor = conductor_3_2()
    first = list(conductor.advance(0, LEAD_NS))
    window = Window(m=0, start=0, update=3, hold=2)
    assert first == [WindowEntered(window, 0), PhaseEntered(window, "update", 0, "schedule")]
    assert walk(conductor, [899, 900, 950]) == [[], [PublishDue(window, 1)], []]
    assert walk(conductor, [1000, 1900]) == [[UnitEnded(0)], [PublishDue(window, 2)]]
    assert walk(conductor, [2000, 2999]) == [[UnitEnded(1)], [PublishDue(window, 3)]]
    assert improves(conductor)
    assert list(conductor.advance(3000, LEAD_NS)) == [
        UnitEnded(2),
        PhaseEntered(window, "hold", 3000, "schedule"),
    ]
    assert not improves(conductor)
    assert walk(conductor, [3950, 4000, 4950]) == [[], [UnitEnded(3)], []]
    following = Window(m=1, start=5, update=3, hold=2)
    assert list(conductor.advance(5000, LEAD_NS)) == [
        UnitEnded(4),
        WindowEntered(following, 5),
        PhaseEntered(following, "update", 5000, "schedule"),
    ]


def test_an_iterate_whose_unit_passed_unseen_is_missed_not_published_in_the_hold() -> None:
    conductor = conductor_3_2()
    window = Window(m=0, start=0, update=3, hold=2)
    list(conductor.advance(2500, LEAD_NS))
    assert list(conductor.advance(3200, LEAD_NS)) == [
        UnitEnded(2),
        PublishMissed(window, 3),
        PhaseEntered(window, "hold", 3000, "schedule"),
    ]


def test_a_stall_over_a_whole_hold_reports_all_that_passed_in_order() -> None:
    conductor = conductor_3_2()
    window, following = Window(m=0, start=0, update=3, hold=2), Window(m=1, start=5, update=3, hold=2)
    list(conductor.advance(900, LEAD_NS))
    assert list(conductor.advance(5950, LEAD_NS)) == [
        UnitEnded(0),
        UnitEnded(1),
        PublishMissed(window, 2),
        UnitEnded(2),
        PublishMissed(window, 3),
        PhaseEntered(window, "hold", 3000, "schedule"),
        UnitEnded(3),
        UnitEnded(4),
        WindowEntered(following, 5),
        PhaseEntered(following, "update", 5000, "schedule"),
        PublishDue(following, 1),
    ]


def test_a_late_start_enters_the_window_that_runs() -> None:
    conductor = conductor_3_2()
    window = Window(m=2, start=10, update=3, hold=2)
    assert list(conductor.advance(11_400, LEAD_NS)) == [
        WindowEntered(window, 11),
        PhaseEntered(window, "update", 11_400, "schedule"),
    ]
    assert list(conductor.advance(11_950, LEAD_NS)) == [PublishDue(window, 2)]


def test_the_papers_example() -> None:
    conductor = Conductor(WindowClock(ExplicitSchedule(t_m=(0, 13, 25), g_m=(10, 4, 5)), UNIT_NS))
    due = [
        (h.window.m, h.iterate, instant // UNIT_NS)
        for instant in range(0, 40_000, 50)
        for h in conductor.advance(instant, LEAD_NS)
        if isinstance(h, PublishDue)
    ]
    assert due == (
        [(0, g, g - 1) for g in range(1, 11)]
        + [(1, g, 13 + g - 1) for g in range(1, 5)]
        + [(2, g, 25 + g - 1) for g in range(1, 6)]
    )


def test_an_operators_hold_stops_improving_and_resume_goes_on() -> None:
    conductor = conductor_3_2()
    window = Window(m=0, start=0, update=3, hold=2)
    list(conductor.advance(200, LEAD_NS))
    assert conductor.pause(300) == [PhaseEntered(window, "hold", 300, "operator")]
    assert conductor.pause(310) == []
    assert not improves(conductor)
    assert list(conductor.advance(950, LEAD_NS)) == []
    assert list(conductor.advance(1100, LEAD_NS)) == [UnitEnded(0), PublishMissed(window, 1)]
    assert conductor.resume(1200) == [PhaseEntered(window, "update", 1200, "operator")]
    assert improves(conductor)
    assert list(conductor.advance(1950, LEAD_NS)) == [PublishDue(window, 2)]


def test_a_unit_that_an_operator_held_throughout_misses_nothing() -> None:
    conductor = conductor_3_2()
    window = Window(m=0, start=0, update=3, hold=2)
    list(conductor.advance(200, LEAD_NS))
    conductor.pause(300)
    assert list(conductor.advance(2100, LEAD_NS)) == [UnitEnded(0), PublishMissed(window, 1), UnitEnded(1)]
    conductor.resume(2200)
    conductor.pause(2300)
    assert list(conductor.advance(3100, LEAD_NS)) == [UnitEnded(2), PublishMissed(window, 3)]


def test_a_resume_inside_a_scheduled_hold_stays_in_it() -> None:
    conductor = conductor_3_2()
    list(conductor.advance(200, LEAD_NS))
    conductor.pause(300)
    list(conductor.advance(3500, LEAD_NS))
    assert conductor.resume(3600) == []
    assert not improves(conductor)


def test_an_operators_hold_that_lasts_into_the_next_window_is_named_in_it() -> None:
    conductor = conductor_3_2()
    following = Window(m=1, start=5, update=3, hold=2)
    list(conductor.advance(3500, LEAD_NS))
    assert conductor.pause(3600) == []  # held already
    assert list(conductor.advance(5100, LEAD_NS))[-1] == PhaseEntered(following, "hold", 5000, "operator")
    assert conductor.resume(5200) == [PhaseEntered(following, "update", 5200, "operator")]
