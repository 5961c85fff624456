"""How long a process waited for a core: the rule, and what this system's kernel makes of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from launcher.run_delay import RunDelay, Thread, grown_ns, read

MS = 1_000_000
BUSY = "print('up', flush=True)\nwhile True: pass"
IDLE = "print('up', flush=True)\nimport time\nwhile True: time.sleep(1)"


@pytest.mark.parametrize(
    ("now", "expected_ms"),
    [
        (Thread(9 * MS, 30 * MS, runnable=False), 20),  # it waited 20 ms and did its work
        (Thread(9 * MS, 30 * MS, runnable=True), 20),  # it is at work
        (Thread(4 * MS, 10 * MS, runnable=True), 50),  # it waits, and that is not entered yet
        (Thread(4 * MS, 10 * MS, runnable=False), 0),  # it sleeps, or is stopped
        (Thread(5 * MS, 910 * MS, runnable=False), 50),  # a wait of 0.9 s is over; most of it was before
    ],
)
def test_the_rule(now: Thread, expected_ms: int) -> None:
    before = Thread(4 * MS, 10 * MS, runnable=True)
    assert grown_ns(before, now, 50 * MS) == expected_ms * MS


def test_who_has_just_been_woken_did_not_wait_before() -> None:
    asleep, woken = Thread(4 * MS, 10 * MS, runnable=False), Thread(4 * MS, 10 * MS, runnable=True)
    assert grown_ns(asleep, woken, 8000 * MS) == 0


def test_a_kernel_that_counts_nothing_excuses_nothing() -> None:
    assert grown_ns(Thread(0, 0, runnable=True), Thread(0, 0, runnable=True), 50 * MS) == 0


@contextmanager
def running(program: str, count: int = 1) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Processes on one core, which they share."""
    core = min(os.sched_getaffinity(0))
    command = [sys.executable, "-c", f"import os; os.sched_setaffinity(0, {{{core}}})\n{program}"]
    found = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(count)]
    try:
        for process in found:
            assert process.stdout is not None
            assert process.stdout.readline() == b"up\n"
        yield found
    finally:
        for process in found:
            process.kill()
            process.communicate()


def waited_share(pid: int, seconds: float, looks: int) -> float:
    """The share of the time that a process waited, by so many looks."""
    delay, began_ns = RunDelay(pid), time.monotonic_ns()
    waited_ns = delay.grown_ns(began_ns)
    for _ in range(looks):
        time.sleep(seconds / looks)
        waited_ns += delay.grown_ns(time.monotonic_ns())
    return waited_ns / (time.monotonic_ns() - began_ns)


def test_three_that_compute_on_one_core_wait_for_each_other() -> None:
    with running(BUSY, 3) as (process, *_):
        assert waited_share(process.pid, 1.0, 10) > 0.4  # 2/3, and more if others compute there


def test_who_sleeps_or_is_stopped_waits_for_no_core() -> None:
    with running(IDLE) as (idle,):
        assert waited_share(idle.pid, 0.3, 3) < 0.5
    with running(BUSY) as (stopped,):
        stopped.send_signal(signal.SIGSTOP)
        assert os.waitpid(stopped.pid, os.WUNTRACED)[0] == stopped.pid
        assert waited_share(stopped.pid, 0.3, 3) == 0


def test_who_has_gone_waits_for_nothing() -> None:
    with running(IDLE) as (process,):
        delay = RunDelay(process.pid)
        assert delay.grown_ns(0) == 0
        assert list(read(process.pid)) == [str(process.pid)]
    assert read(process.pid) == {}
    assert delay.grown_ns(10**9) == 0
