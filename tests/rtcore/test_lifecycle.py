"""Stopping in order, and the log."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from rtcore.clock import VirtualClock
from rtcore.lifecycle import (
    Continuations,
    RateLimited,
    Stop,
    die_with_parent,
    stop_on_signals,
)

ROOT = Path(__file__).parents[2]


def test_a_stop_keeps_its_first_reason() -> None:
    stop = Stop()
    assert (stop.is_set(), stop.reason, stop.wait(0.0)) == (False, "", False)
    stop.set("the duration is over")
    stop.set("SIGTERM")
    assert (stop.is_set(), stop.reason, stop.wait(0.0)) == (True, "the duration is over", True)
    assert stop.wait(-1.0)


def test_a_wait_that_nobody_ends_takes_its_time() -> None:
    began = time.monotonic()
    assert not Stop().wait(0.02)
    assert time.monotonic() - began >= 0.019


def test_a_stop_wakes_all_who_wait() -> None:
    stop = Stop()
    results: list[bool] = []
    threads = [threading.Thread(target=lambda: results.append(stop.wait(20.0))) for _ in range(5)]
    for thread in threads:
        thread.start()
    began = time.monotonic()
    stop.set("now")
    for thread in threads:
        thread.join()
    assert results == [True] * 5
    assert time.monotonic() - began < 10.0


def test_waits_go_on_after_the_process_was_stopped_for_longer_than_they_last() -> None:
    """On a `queue.SimpleQueue` some of these threads hang for good: those that a signal meets."""
    code = """
import signal, threading, time
from rtcore.lifecycle import Stop

signal.signal(signal.SIGCONT, lambda number, frame: None)
stop, waits = Stop(), [0] * 20

def run(index):
    while True:
        stop.wait(0.05)
        waits[index] += 1

for index in range(20):
    threading.Thread(target=run, args=(index,), daemon=True).start()
print("up", flush=True)
input()
before = list(waits)
time.sleep(0.6)
print(sum(now > then for now, then in zip(waits, before)), flush=True)
"""
    command = [sys.executable, "-c", code]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdin is not None and child.stdout is not None
        assert child.stdout.readline() == "up\n"
        for _ in range(12):
            time.sleep(0.02)
            child.send_signal(signal.SIGSTOP)
            time.sleep(0.1)
            child.send_signal(signal.SIGCONT)
        child.stdin.write("\n")
        child.stdin.flush()
        assert child.stdout.readline() == "20\n"
        child.kill()


def test_signals_that_interrupt_a_stop_at_work_do_not_block_it() -> None:
    """With a threading.Event inside, two signals that set it while it is being set or waited on deadlock."""
    code = """
import signal, time
from rtcore.lifecycle import Stop
stop, sets, woken = Stop(), 0, 0
def handle(number, frame):
    global sets
    sets += 1
    stop.set(f"signal {number}")
for number in (signal.SIGALRM, signal.SIGPROF):
    signal.signal(number, handle)
signal.setitimer(signal.ITIMER_REAL, 0.0002, 0.0001)
signal.setitimer(signal.ITIMER_PROF, 0.0002, 0.0002)
end = time.monotonic() + 0.5
while time.monotonic() < end:
    stop = Stop()
    woken += stop.wait(0.00005)
signal.setitimer(signal.ITIMER_REAL, 0)
signal.setitimer(signal.ITIMER_PROF, 0)
print(sets > 100, woken > 10)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=20, check=True
    )
    assert done.stdout == "True True\n", done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_set_the_stop_and_the_old_handlers_come_back(number: signal.Signals) -> None:
    before = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM)}
    stop = Stop()
    with stop_on_signals(stop):
        os.kill(os.getpid(), number)
        assert stop.wait(5.0)
    assert stop.reason == number.name
    assert {name: signal.getsignal(name) for name in before} == before


def test_handlers_come_back_after_an_error() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyError), stop_on_signals(Stop()):
        raise KeyError
    assert signal.getsignal(signal.SIGTERM) == before


CHILD = """
import os, sys, time
from rtcore.lifecycle import Stop, die_with_parent, stop_on_signals
stop = Stop()
with stop_on_signals(stop):
    assert die_with_parent(int(sys.argv[1]) if len(sys.argv) > 1 else None)
    print(os.getpid(), flush=True)
    stop.wait(20.0)
    print(stop.reason, flush=True)
"""
PARENT = """
import subprocess, sys
subprocess.run([sys.executable, "-c", sys.argv[1]])
"""


def test_a_child_gets_sigterm_when_its_parent_is_killed() -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, CHILD], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    with parent:
        assert parent.stdout is not None
        int(parent.stdout.readline())  # the child is set up
        parent.kill()
        assert parent.stdout.readline() == "SIGTERM\n"


def test_a_parent_that_is_gone_already_counts_as_ended() -> None:
    nobody = "1" if os.getpid() != 1 else "2"
    done = subprocess.run(
        [sys.executable, "-c", CHILD, nobody],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=20,
        check=True,
    )
    assert done.stdout.splitlines()[1] == "SIGTERM"


def test_where_the_kernel_offers_no_such_thing_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rtcore.libc._prctl", None)
    assert not die_with_parent()


def test_a_continuation_is_stamped_once_and_told_once() -> None:
    clock = VirtualClock(5)
    continuations = Continuations(clock.now_ns)
    assert (continuations.newest_ns(), continuations.all_ns()) == (0, ())
    with continuations.watched():
        for _ in range(20):
            clock.advance_ns(10)
            signal.raise_signal(signal.SIGCONT)
            assert continuations.newest_ns() == clock.now_ns()
        clock.advance_ns(1)
        assert continuations.all_ns() == tuple(range(55, 206, 10))  # the newest 16
        assert list(continuations.untold_ns()) == list(continuations.all_ns())
        assert list(continuations.untold_ns()) == []
        signal.raise_signal(signal.SIGCONT)
        assert list(continuations.untold_ns()) == [206]
    signal.raise_signal(signal.SIGCONT)
    assert continuations.newest_ns() == 206


def test_other_signals_are_no_continuation() -> None:
    continuations = Continuations(VirtualClock(5).now_ns)
    with continuations.watched(), stop_on_signals(stop := Stop()):
        signal.raise_signal(signal.SIGTERM)
        assert stop.reason == "SIGTERM"
        assert continuations.newest_ns() == 0
        signal.raise_signal(signal.SIGCONT)
        assert continuations.newest_ns() == 5


def test_another_thread_sees_a_continuation_before_the_main_thread_handles_it() -> None:
    # The main thread is in C code for 0.3 s (one hash), so no handler of Python's runs until its end.
    child = """
import hashlib, os, signal, threading, time
from rtcore.lifecycle import Continuations
continuations = Continuations(time.monotonic_ns)
seen = []
def look():
    time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGCONT)
    limit = time.monotonic() + 20
    while not continuations.newest_ns() and time.monotonic() < limit:
        pass
    seen.append(continuations.newest_ns())
with continuations.watched():
    thread = threading.Thread(target=look)
    thread.start()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 500_000)
    ended_ns = time.monotonic_ns()
    thread.join()
    assert 0 < seen[0] < ended_ns, (seen, ended_ns)
    assert continuations.all_ns() == tuple(seen)
"""
    done = subprocess.run(
        [sys.executable, "-c", child], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_rate_limited_logs_one_line_per_period_and_counts_the_rest(caplog: pytest.LogCaptureFixture) -> None:
    clock = VirtualClock()
    limited = RateLimited(logging.getLogger("bus"), 2.0, now_ns=clock.now_ns)
    logged = []
    for _ in range(5):  # at 0, 0.9, 1.8, 2.7, 3.6 s
        logged.append(limited.warning("bad message on %s", "step"))
        clock.advance_ns(900_000_000)
    clock.advance_ns(200_000_000)  # 4.7 s: a period after 2.7 s
    logged.append(limited.error("100% bad"))
    assert logged == [True, False, False, True, False, True]
    assert [record.getMessage() for record in caplog.records] == [
        "bad message on step",
        "bad message on step (2 more like it were not logged)",
        "100% bad (1 more like it were not logged)",
    ]
    assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING", "ERROR"]
    assert limited.suppressed == 3


def test_rate_limited_lets_a_line_through_exactly_one_period_later(caplog: pytest.LogCaptureFixture) -> None:
    clock = VirtualClock()
    limited = RateLimited(logging.getLogger("bus"), 2.0, now_ns=clock.now_ns)
    assert limited.warning("50% bad")
    clock.advance_ns(1_999_999_999)
    assert not limited.warning("50% bad")
    clock.advance_ns(1)
    assert limited.warning("50% bad")
    assert caplog.records[0].getMessage() == "50% bad"
