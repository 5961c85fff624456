"""The wall clock: never early, on time when the machine lets it, and open to signals."""

from __future__ import annotations

import errno
import os
import signal
import threading
import time

import pytest

from rtcore import libc
from rtcore.monotonic import LONG_TAIL_NS, SHORT_TAIL_NS, MonotonicClock


def test_it_is_the_clock_of_every_process_of_the_host() -> None:
    before = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    now = MonotonicClock().now_ns()
    assert before <= now <= time.clock_gettime_ns(time.CLOCK_MONOTONIC)


def test_it_never_returns_early_and_mostly_returns_on_time() -> None:
    clock = MonotonicClock()
    late_ns = []
    for _ in range(30):
        deadline_ns = clock.now_ns() + 1_000_000
        clock.sleep_until_ns(deadline_ns)
        late_ns.append(clock.now_ns() - deadline_ns)
    assert min(late_ns) >= 0
    assert sorted(late_ns)[len(late_ns) // 4] < 1_000_000  # a quarter may be late on a busy machine


@pytest.mark.parametrize("deadline_ns", [-1, 0, 1])
def test_a_deadline_in_the_past_returns_at_once(deadline_ns: int) -> None:
    began = time.monotonic()
    MonotonicClock().sleep_until_ns(deadline_ns)
    assert time.monotonic() - began < 0.1


@pytest.mark.parametrize(("sleep_ns", "tail_ns"), [(3_000_000, SHORT_TAIL_NS), (12_000_000, LONG_TAIL_NS)])
def test_it_sleeps_until_a_tail_before_the_deadline_and_spins_the_rest(
    sleep_ns: int, tail_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    really_sleep = libc.sleep_until_ns

    def sleep(deadline_ns: int) -> None:
        asked.append(deadline_ns)
        really_sleep(deadline_ns)

    monkeypatch.setattr(libc, "sleep_until_ns", sleep)
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + sleep_ns
    clock.sleep_until_ns(deadline_ns)
    assert asked[0] == deadline_ns - tail_ns
    assert clock.now_ns() >= deadline_ns


def test_a_signal_handler_runs_during_the_wait_and_the_wait_goes_on() -> None:
    handled_ns: list[int] = []
    previous = signal.signal(signal.SIGUSR1, lambda *_: handled_ns.append(time.monotonic_ns()))
    timer = threading.Timer(0.02, os.kill, args=(os.getpid(), signal.SIGUSR1))
    try:
        clock = MonotonicClock()
        deadline_ns = clock.now_ns() + 300_000_000
        timer.start()
        clock.sleep_until_ns(deadline_ns)
        assert clock.now_ns() >= deadline_ns
    finally:
        timer.join()
        signal.signal(signal.SIGUSR1, previous)
    assert len(handled_ns) == 1
    assert handled_ns[0] < deadline_ns - 100_000_000


def test_a_sleep_that_a_signal_cut_short_is_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def sleep(deadline_ns: int) -> None:
        asked.append(deadline_ns)
        if len(asked) == 4:
            time.sleep(max(0, deadline_ns - time.monotonic_ns()) / 1e9)

    monkeypatch.setattr(libc, "sleep_until_ns", sleep)
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + 50_000_000
    clock.sleep_until_ns(deadline_ns)
    assert asked == [deadline_ns - LONG_TAIL_NS] * 4  # three early returns, then a whole sleep; no long spin
    assert clock.now_ns() >= deadline_ns


def test_the_sleep_lets_other_threads_run() -> None:
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + 400_000_000
    sleeper = threading.Thread(target=clock.sleep_until_ns, args=(deadline_ns,))
    sleeper.start()
    passed_ns = clock.now_ns()  # with the GIL held in the sleep, this would come after the deadline
    sleeper.join()
    assert passed_ns < deadline_ns - 100_000_000


def test_without_the_system_call_it_still_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libc, "_clock_nanosleep", None)
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + 5_000_000
    clock.sleep_until_ns(deadline_ns)
    assert clock.now_ns() >= deadline_ns


def test_calls_that_do_not_exist_or_are_refused_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OSError, match="prctl: Invalid argument") as refused:
        libc.prctl(-1)
    assert refused.value.errno == errno.EINVAL
    monkeypatch.setattr(libc, "_mlockall", None)
    with pytest.raises(OSError, match="mlockall does not exist") as absent:
        libc.mlockall(libc.MCL_CURRENT)
    assert absent.value.errno == errno.ENOSYS
