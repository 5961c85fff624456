"""The pacer on a clock that moves by exactly as much as the work takes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcore.clock import VirtualClock
from rtcore.config import ConfigError
from rtcore.lifecycle import Stop
from rtcore.monotonic import MonotonicClock
from rtcore.pacer import SLICE_NS, Pacer, Tick

T0 = 5_000
PERIOD = 100


def run(
    work_ns: dict[int, int], *, end_index: int, start_ns: int = 0, period_ns: int = PERIOD
) -> tuple[list[Tick], Pacer]:
    """All ticks, when the work of tick k takes `work_ns[k]` (else nothing)."""
    clock = VirtualClock(start_ns)
    pacer = Pacer(clock, t0_ns=T0, period_ns=period_ns, end_index=end_index)
    ticks = []
    for tick in pacer.ticks(Stop()):
        ticks.append(tick)
        clock.advance_ns(work_ns.get(tick.index, 0))
    return ticks, pacer


def on_time(index: int) -> Tick:
    return Tick(index, T0 + index * PERIOD, T0 + index * PERIOD, 0)


def test_without_work_every_tick_is_on_its_deadline() -> None:
    ticks, pacer = run({}, end_index=4)
    assert ticks == [on_time(0), on_time(1), on_time(2), on_time(3)]
    assert (pacer.executed, pacer.overruns, pacer.skipped_total) == (4, 0, 0)


@pytest.mark.parametrize(
    ("work_ns", "after"),
    [
        (30, on_time(2)),  # 0.3 of a period
        (99, on_time(2)),
        (100, on_time(2)),  # exactly D_2: on time
        (101, Tick(2, 5200, 5201, 0)),  # late by 1 ns, within its own period
        (199, Tick(2, 5200, 5299, 0)),
        (200, Tick(3, 5300, 5300, 1)),  # exactly D_3: D_2 is lost
        (250, Tick(3, 5300, 5350, 1)),  # 2.5 periods
        (399, Tick(4, 5400, 5499, 2)),
        (400, Tick(5, 5500, 5500, 3)),
    ],
)
def test_a_long_tick_skips_what_it_slept_through_and_keeps_the_phase(work_ns: int, after: Tick) -> None:
    ticks, pacer = run({1: work_ns}, end_index=8)
    rest = [on_time(index) for index in range(after.index + 1, 8)]
    assert ticks == [on_time(0), on_time(1), after, *rest]
    assert pacer.skipped_total == after.skipped
    assert pacer.overruns == (1 if after.skipped else 0)
    assert pacer.executed == 8 - after.skipped


def test_a_backlog_below_one_period_is_worked_off_without_a_loss() -> None:
    ticks, pacer = run({0: 180, 1: 10}, end_index=4)
    assert ticks == [on_time(0), Tick(1, 5100, 5180, 0), on_time(2), on_time(3)]
    assert pacer.overruns == 0


def test_two_overruns_in_a_row_count_as_two() -> None:
    ticks, pacer = run({0: 250, 2: 330}, end_index=7)
    assert ticks == [on_time(0), Tick(2, 5200, 5250, 1), Tick(5, 5500, 5580, 2), on_time(6)]
    assert (pacer.executed, pacer.overruns, pacer.skipped_total) == (4, 2, 3)


def test_a_late_start_skips_to_the_current_tick() -> None:
    ticks, pacer = run({}, end_index=5, start_ns=T0 + 310)
    assert ticks == [Tick(3, 5300, 5310, 3), on_time(4)]
    assert (pacer.overruns, pacer.skipped_total) == (1, 3)


@pytest.mark.parametrize("work_ns", [300, 350, 100_000])  # until D_4, the end, and beyond
def test_an_overrun_past_the_end_loses_the_rest(work_ns: int) -> None:
    ticks, pacer = run({1: work_ns}, end_index=4)
    assert ticks == [on_time(0), on_time(1)]
    assert (pacer.executed, pacer.overruns, pacer.skipped_total) == (2, 1, 2)


def test_no_ticks_when_the_end_is_the_beginning() -> None:
    ticks, pacer = run({}, end_index=0)
    assert ticks == []
    assert (pacer.executed, pacer.overruns, pacer.skipped_total) == (0, 0, 0)


def test_a_stop_during_the_work_ends_the_ticks() -> None:
    clock, stop = VirtualClock(), Stop()
    pacer = Pacer(clock, t0_ns=T0, period_ns=PERIOD)
    seen = []
    for tick in pacer.ticks(stop):
        seen.append(tick.index)
        if tick.index == 2:
            stop.set("enough")
    assert seen == [0, 1, 2]
    assert clock.now_ns() == T0 + 2 * PERIOD


def test_a_stop_before_the_start_yields_nothing_and_waits_for_nothing() -> None:
    clock, stop = VirtualClock(), Stop()
    stop.set("never mind")
    assert list(Pacer(clock, t0_ns=T0, period_ns=PERIOD).ticks(stop)) == []
    assert clock.now_ns() == 0


def test_ticks_go_on_where_they_were_left() -> None:
    clock = VirtualClock()
    pacer = Pacer(clock, t0_ns=T0, period_ns=PERIOD, end_index=3)
    assert next(pacer.ticks(Stop())) == on_time(0)
    assert list(pacer.ticks(Stop())) == [on_time(1), on_time(2)]


class StoppingClock(VirtualClock):
    """Sets a stop once it has come to an instant, as a signal handler would during a sleep."""

    def __init__(self, stop: Stop, at_ns: int) -> None:
        super().__init__()
        self._stop = stop
        self._at_ns = at_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        super().sleep_until_ns(deadline_ns)
        if self.now_ns() >= self._at_ns:
            self._stop.set("signal")


def test_a_stop_during_a_wait_of_seconds_is_seen_within_a_slice_and_yields_no_tick() -> None:
    stop = Stop()
    clock = StoppingClock(stop, at_ns=3_000_000_000)
    pacer = Pacer(clock, t0_ns=0, period_ns=10_000_000_000)
    assert [tick.index for tick in pacer.ticks(stop)] == [0]
    assert 3_000_000_000 <= clock.now_ns() <= 3_000_000_000 + SLICE_NS
    assert pacer.executed == 1


class SlicedClock(VirtualClock):
    """Notes how long each sleep was."""

    def __init__(self) -> None:
        super().__init__()
        self.sleeps: list[int] = []

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self.sleeps.append(deadline_ns - self.now_ns())
        super().sleep_until_ns(deadline_ns)


def test_a_long_wait_is_cut_into_equal_slices_that_end_on_the_deadline() -> None:
    clock = SlicedClock()
    ticks = list(Pacer(clock, t0_ns=0, period_ns=500_000_001, end_index=2).ticks(Stop()))
    assert clock.sleeps == [166_666_667, 166_666_667, 166_666_667]
    assert ticks[1] == Tick(1, 500_000_001, 500_000_001, 0)


def test_a_clock_that_wakes_early_is_asked_again() -> None:
    class EarlyClock(VirtualClock):
        def sleep_until_ns(self, deadline_ns: int) -> None:
            super().sleep_until_ns(deadline_ns - (deadline_ns - self.now_ns()) // 2)

    ticks = list(Pacer(EarlyClock(), t0_ns=T0, period_ns=PERIOD, end_index=3).ticks(Stop()))
    assert ticks == [on_time(0), on_time(1), on_time(2)]


@pytest.mark.parametrize("period_ns", [0, -1])
def test_a_period_must_be_positive(period_ns: int) -> None:
    with pytest.raises(ConfigError, match=f"period_ns = {period_ns}: must be a positive"):
        Pacer(VirtualClock(), t0_ns=0, period_ns=period_ns)


def reference(work: list[int], end_index: int) -> Iterator[tuple[int, int, int]]:
    """(index, woke, skipped) by walking through every deadline, one at a time."""
    now, index, skipped = 0, 0, 0
    durations = iter(work)
    while index < end_index:
        now = max(now, T0 + index * PERIOD)
        if now >= T0 + (index + 1) * PERIOD:
            index, skipped = index + 1, skipped + 1
            continue
        yield index, now, skipped
        now += next(durations, 0)
        index, skipped = index + 1, 0


@given(
    work=st.lists(st.integers(0, 6 * PERIOD) | st.sampled_from([PERIOD, 2 * PERIOD]), max_size=40),
    end_index=st.integers(0, 60),
)
def test_the_pacer_agrees_with_a_walk_through_every_deadline(work: list[int], end_index: int) -> None:
    clock = VirtualClock()
    pacer = Pacer(clock, t0_ns=T0, period_ns=PERIOD, end_index=end_index)
    durations = iter(work)
    ticks = []
    for tick in pacer.ticks(Stop()):
        ticks.append(tick)
        clock.advance_ns(next(durations, 0))
    assert [(tick.index, tick.woke_ns, tick.skipped) for tick in ticks] == list(reference(work, end_index))
    assert all(tick.due_ns == T0 + tick.index * PERIOD for tick in ticks)
    assert pacer.executed == len(ticks)
    assert pacer.executed + pacer.skipped_total == end_index


def test_on_the_real_clock_a_stop_from_another_thread_ends_a_wait_of_seconds() -> None:
    stop, clock = Stop(), MonotonicClock()
    pacer = Pacer(clock, t0_ns=clock.now_ns() + 30_000_000_000, period_ns=1_000_000_000)
    timer = threading.Timer(0.03, stop.set, args=("enough",))
    timer.start()
    began = time.monotonic()
    assert list(pacer.ticks(stop)) == []
    timer.join()
    assert time.monotonic() - began < 0.03 + 0.25 + 0.2  # the promise, and a busy machine's delay


def test_a_later_life_begins_in_the_middle() -> None:
    """D_7 = 5700; nothing before it is waited for, skipped or counted."""
    clock = VirtualClock(5_650)
    pacer = Pacer(clock, t0_ns=T0, period_ns=PERIOD, first_index=7, end_index=9)
    assert list(pacer.ticks(Stop())) == [on_time(7), on_time(8)]
    assert (pacer.executed, pacer.overruns, pacer.skipped_total) == (2, 0, 0)
    assert list(Pacer(clock, t0_ns=T0, period_ns=PERIOD, first_index=9, end_index=9).ticks(Stop())) == []


def test_t0_may_lie_before_the_clock_began() -> None:
    pacer = Pacer(VirtualClock(0), t0_ns=-5_050, period_ns=PERIOD, first_index=51, end_index=53)
    assert [tick.due_ns for tick in pacer.ticks(Stop())] == [50, 150]


def test_the_heart_beats_at_every_tick_and_through_a_long_wait() -> None:
    """A tick each 0.5 s: 3 slices of a wait, and the look at its end."""
    clock, beats = VirtualClock(0), list[int]()
    pacer = Pacer(clock, t0_ns=0, period_ns=500_000_000, end_index=3, beat=beats.append)
    assert len(list(pacer.ticks(Stop()))) == 3
    assert beats[0] == 0 and beats[-1] == 1_000_000_000
    assert max(after - before for before, after in pairwise(beats)) <= SLICE_NS
