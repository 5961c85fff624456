"""What a number of misses proves, and how the search for the highest rate goes about it."""

from __future__ import annotations

import pytest

from launcher.latency.hold_rate import (
    Counted,
    Search,
    lower_bound,
    search,
    statement,
    ticks_needed,
    upper_bound,
)

LADDER = (100.0, 200.0, 250.0, 400.0, 500.0, 800.0, 1000.0)


def test_how_many_ticks_without_a_miss_are_enough() -> None:
    assert ticks_needed(limit=1e-4, confidence=0.95) == 29_956  # ln 0.05 / ln 0.9999 = 29 955.8
    assert upper_bound(Counted(29_956, 0)) < 1e-4 < upper_bound(Counted(29_955, 0))
    assert ticks_needed(limit=0.1, confidence=0.5) == 7  # 0.9^7 = 0.478, 0.9^6 = 0.531


def test_bounds_by_hand() -> None:
    assert upper_bound(Counted(10, 0)) == pytest.approx(1 - 0.05 ** (1 / 10))
    assert upper_bound(Counted(3, 3)) == 1.0
    assert lower_bound(Counted(3, 0)) == 0.0
    assert lower_bound(Counted(10, 1)) == pytest.approx(1 - 0.95 ** (1 / 10))
    assert lower_bound(Counted(3, 3)) == pytest.approx(0.05 ** (1 / 3))
    # One of two: P(X <= 1) = 1 - p^2 = 0.05, and P(X >= 1) = 1 - (1 - p)^2 = 0.05.
    assert upper_bound(Counted(2, 1)) == pytest.approx(0.95**0.5)
    assert lower_bound(Counted(2, 1)) == pytest.approx(1 - 0.95**0.5)
    assert upper_bound(Counted(10, 1)) == pytest.approx(0.39416, abs=1e-5)  # Clopper and Pearson's tables
    assert upper_bound(Counted(10_000, 5_000)) == pytest.approx(0.5083, abs=1e-4)  # no overflow


class Machine:
    """Misses nothing up to `clean_hz`; above, in runs of a thousand ticks or longer, a share of them."""

    def __init__(self, clean_hz: float, *, long_clean_hz: float | None = None) -> None:
        self.clean_hz = clean_hz
        self.long_clean_hz = clean_hz if long_clean_hz is None else long_clean_hz
        self.asked: list[tuple[float, float]] = []

    def measure(self, hz: float, seconds: float) -> Counted:
        self.asked.append((hz, seconds))
        ticks = round(hz * seconds)
        if hz <= self.long_clean_hz:
            return Counted(ticks, 0)
        if hz <= self.clean_hz:  # one miss in a long run, which a short one does not see
            return Counted(ticks, int(ticks >= 20_000))
        return Counted(ticks, ticks // 100)


def run(machine: Machine) -> Search:
    found = Search()
    search(machine.measure, LADDER, found)
    assert found.ended
    return found


def test_strides_double_then_bisect_and_the_long_run_decides() -> None:
    machine = Machine(500.0)
    found = run(machine)
    assert found.established_hz == 500.0
    # Strides 1, 2, 4 up to the refuted 1000, then halves between 250 and it.
    assert machine.asked[:-1] == [(100.0, 10.0), (250.0, 5.0), (1000.0, 5.0), (500.0, 5.0), (800.0, 5.0)]
    hz, seconds = machine.asked[-1]
    assert hz == 500.0 and round(hz * seconds) == 29_956
    assert [attempt.stage for attempt in found.attempts] == ["screening"] * 5 + ["confirmation"]


def test_a_failed_confirmation_steps_down() -> None:
    machine = Machine(500.0, long_clean_hz=250.0)
    found = run(machine)
    assert found.established_hz == 250.0
    assert [a.hz for a in found.attempts if a.stage == "confirmation"] == [500.0, 400.0, 250.0]
    lines = statement(found)
    assert lines[0].startswith("250 Hz is held: 0 of 29,956 deadlines were missed")
    assert "95 % confidence" in lines[0]
    assert "400 Hz is not: 1 of 29,956 deadlines missed in confirmation (neither shown nor refuted)." in lines
    assert "800 Hz is not: 40 of 4,000 deadlines missed in screening (at least 0.0076)." in lines


def test_the_whole_ladder_held() -> None:
    assert run(Machine(5000.0)).established_hz == 1000.0


def test_nothing_held_takes_no_long_run() -> None:
    machine = Machine(50.0)
    found = run(machine)
    assert found.established_hz is None
    assert machine.asked == [(100.0, 10.0)]
    assert statement(found)[0] == "No rate is shown to keep the miss ratio below 0.0001."


def test_what_was_found_before_an_interruption_stays() -> None:
    machine, found = Machine(500.0), Search()

    def measure(hz: float, seconds: float) -> Counted:
        if len(machine.asked) == 2:
            raise KeyboardInterrupt
        return machine.measure(hz, seconds)

    with pytest.raises(KeyboardInterrupt):
        search(measure, LADDER, found)
    assert [attempt.hz for attempt in found.attempts] == [100.0, 250.0]
    assert not found.ended and statement(found)[0] == "The search was interrupted."
