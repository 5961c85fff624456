"""Windows that are chosen as they begin, and schedules that an operator changes, against lists by hand."""

from __future__ import annotations

import json

import pytest

from learner.schedule.timetable import Timetable, best, cut
from rtcore.config import BoundConfig, ConfigError, ScheduleConfig
from rtcore.windows import Window

FIXED = ScheduleConfig(l_f=5, gamma_f=0.6)
AUTO = ScheduleConfig(kind="auto", l_f=4)


class Asked:
    """Chooses 1, 2, 3, ... units of update, and remembers what for."""

    def __init__(self) -> None:
        self.starts: list[int] = []

    def __call__(self, schedule: ScheduleConfig, start: int) -> int:
        self.starts.append(start)
        return min(len(self.starts), schedule.l_f)


def windows(timetable: Timetable, units: range) -> list[tuple[int, int, int, int | None]]:
    found = {timetable.window_at(t) for t in units}
    return sorted((window.m, window.start, window.update, window.hold) for window in found)


def test_each_window_is_chosen_once_when_it_is_first_looked_at() -> None:
    asked = Asked()
    timetable = Timetable(AUTO, asked)
    assert asked.starts == []
    assert windows(timetable, range(10)) == [(0, 0, 1, 3), (1, 4, 2, 2), (2, 8, 3, 1)]
    assert windows(timetable, range(4, 10)) == [(1, 4, 2, 2), (2, 8, 3, 1)]
    assert asked.starts == [0, 4, 8]


def test_a_late_start_asks_for_the_window_that_runs() -> None:
    asked = Asked()
    assert Timetable(AUTO, asked).window_at(14) == Window(3, 12, 1, 3)
    assert asked.starts == [12]


def test_a_change_waits_for_the_window_to_end_and_counts_on() -> None:
    asked = Asked()
    timetable = Timetable(FIXED, asked)
    assert timetable.change(AUTO, timetable.window_at(6), 6) == 10
    assert windows(timetable, range(15)) == [(0, 0, 3, 2), (1, 5, 3, 2), (2, 10, 1, 3), (3, 14, 2, 2)]
    assert asked.starts == [10, 14]  # in units of the run, not of the section
    back = ScheduleConfig(kind="explicit", t_m=(0, 3), g_m=(1, 2))
    assert timetable.change(back, timetable.window_at(14), 15) == 18
    assert windows(timetable, range(14, 40)) == [(3, 14, 2, 2), (4, 18, 1, 2), (5, 21, 2, None)]


def test_a_window_without_end_is_ended_after_this_unit() -> None:
    forever = ScheduleConfig(kind="explicit", t_m=(0,), g_m=(3,))
    held, updated = Timetable(forever, Asked()), Timetable(forever, Asked())
    assert held.change(FIXED, held.window_at(7), 7) == 8
    assert windows(held, range(9)) == [(0, 0, 3, 5), (1, 8, 3, 2)]
    assert updated.change(FIXED, updated.window_at(0), 0) == 1
    assert windows(updated, range(2)) == [(0, 0, 1, 0), (1, 1, 3, 2)]


def test_a_second_thought_replaces_the_first() -> None:
    timetable = Timetable(FIXED, Asked())
    now = timetable.window_at(1)
    timetable.change(AUTO, now, 1)
    timetable.change(ScheduleConfig(kind="live"), now, 2)
    assert windows(timetable, range(8)) == [(0, 0, 3, 2), (1, 5, 1, 0), (2, 6, 1, 0), (3, 7, 1, 0)]


def test_what_was_kept_gives_the_same_windows_and_asks_for_none_of_them_again() -> None:
    first, again = Asked(), Asked()
    timetable = Timetable(FIXED, first)
    timetable.change(AUTO, timetable.window_at(0), 0)
    windows(timetable, range(9))
    lived = windows(timetable, range(9, 14))
    later = Timetable(FIXED, again)
    later.load(timetable.dump())
    assert windows(later, range(9, 14)) == lived
    assert again.starts == []
    later.window_at(17)
    assert again.starts == [17]


@pytest.mark.parametrize("data", [b"", b"[]", b"{}", b"[1]", b'[{"start": 0}]', b"\xff"])
def test_what_is_damaged_changes_nothing(data: bytes) -> None:
    timetable = Timetable(FIXED, Asked())
    with pytest.raises(ValueError):  # noqa: PT011 - which kind depends on where it breaks
        timetable.load(data)
    assert timetable.window_at(9) == Window(1, 5, 3, 2)


def test_a_timetable_begins_at_the_beginning() -> None:
    timetable = Timetable(FIXED, Asked())
    sections = json.loads(timetable.dump())
    sections[0]["start"] = 3
    with pytest.raises(ValueError, match="unit 0"):
        timetable.load(json.dumps(sections).encode())


def test_optimal_is_the_bound_s() -> None:
    # x = .1; the hold's budget is 10 times the update's and neither grows: no hold
    costly = BoundConfig(c_1=1.0, c_45=1.0, eta=1.0, tau=0.1, b_1=1.0, b_2=10.0)
    window = best(ScheduleConfig(kind="optimal", l_f=10, bound=costly)).window_at(0)
    assert (window.update, window.hold) == (10, 0)
    # nothing changes in a hold and the policy's distance does not count: hold all but the unit that is due
    free = BoundConfig(c_1=0.0, b_1=1.0, b_2=0.0)
    window = best(ScheduleConfig(kind="optimal", l_f=10, bound=free)).window_at(0)
    assert (window.update, window.hold) == (1, 9)


def test_optimal_needs_constants_that_belong_together() -> None:
    with pytest.raises(ConfigError, match=r"^learner.schedule.bound.eta = 2.0: eta tau must be below 1"):
        best(ScheduleConfig(kind="optimal", bound=BoundConfig(eta=2.0, tau=1.0)))


def test_cutting_keeps_what_ended_before() -> None:
    assert cut(Window(0, 0, 3, 2), 5) == Window(0, 0, 3, 2)
    assert cut(Window(0, 0, 3, 2), 4) == Window(0, 0, 3, 1)
    assert cut(Window(0, 0, 3, None), 3) == Window(0, 0, 3, 0)
