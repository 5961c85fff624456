"""Carrying out: on a virtual clock against fakes, and on real processes of our own."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from launcher.chaos.faults import Done, Execution, Interface, Life, Lives
from launcher.chaos.plan import Deed, Fault
from rtcore.channels import AGENT, LEARNER, RECORDER
from rtcore.clock import VirtualClock

S = 1_000_000_000
T0_NS = 5 * S


class Told:
    """A victim that writes down what it suffered, in seconds of run time."""

    def __init__(self, name: str, clock: VirtualClock, log: list[tuple[float, str, str]]) -> None:
        self.name, self.clock, self.log = name, clock, log

    def suffer(self, deed: Deed) -> None:
        self.log.append(((self.clock.now_ns() - T0_NS) / S, self.name, deed))

    def release(self) -> None:
        self.log.append(((self.clock.now_ns() - T0_NS) / S, self.name, "released"))


class Field:
    """Hands out victims; `absent` says until when, in seconds of run time, a process has no life."""

    def __init__(self, clock: VirtualClock, absent: dict[str, float] | None = None) -> None:
        self.clock, self.absent = clock, absent or {}
        self.log: list[tuple[float, str, str]] = []

    def find(self, process: str) -> Told | None:
        if (self.clock.now_ns() - T0_NS) / S < self.absent.get(process, 0.0):
            return None
        return Told(process, self.clock, self.log)


def carried_out(
    faults: tuple[Fault, ...], absent: dict[str, float] | None = None, ends_s: float = 1e9
) -> tuple[list[tuple[float, str, str]], list[Done]]:
    clock = VirtualClock(T0_NS)
    field = Field(clock, absent)
    execution = Execution(faults, field, clock, T0_NS)
    execution.run(lambda: clock.now_ns() - T0_NS < ends_s * S)
    return field.log, execution.done


def test_deeds_come_in_time_and_faults_overlap() -> None:
    faults = (Fault(1.0, AGENT, "stop", 2.0), Fault(1.5, LEARNER, "kill"), Fault(2.0, RECORDER, "fill", 3.0))
    log, done = carried_out(faults)
    assert log == [
        (1.0, AGENT, "stop"),
        (1.5, LEARNER, "kill"), (1.5, LEARNER, "released"),
        (2.0, RECORDER, "fill"),
        (3.0, AGENT, "continue"), (3.0, AGENT, "released"),
        (5.0, RECORDER, "empty"), (5.0, RECORDER, "released"),
    ]  # fmt: skip
    assert done == [Done(fault, fault.at_s) for fault in faults]
    assert [one.until_s for one in done] == [3.0, 1.5, 5.0]


def test_a_process_between_two_lives_is_waited_for() -> None:
    fault = Fault(1.0, AGENT, "stop", 0.5)
    log, done = carried_out((fault,), {AGENT: 1.2})
    assert log[0] == (1.2, AGENT, "stop")
    assert log[1] == (1.7, AGENT, "continue")  # as long as planned, from when it began
    assert done == [Done(fault, 1.2)]


def test_a_process_that_does_not_come_back_is_given_up_and_the_others_go_on() -> None:
    dead, later = Fault(1.0, AGENT, "kill"), Fault(30.0, LEARNER, "kill")
    log, done = carried_out((dead, later), {AGENT: 1e9})
    assert [process for _, process, _ in log] == [LEARNER, LEARNER]
    assert done == [Done(dead, None), Done(later, 30.0)]


def test_nobody_stays_stopped_when_the_run_ends() -> None:
    stop, never = Fault(1.0, AGENT, "stop", 3.0), Fault(9.0, LEARNER, "kill")
    log, done = carried_out((stop, never), ends_s=2.0)
    assert log == [(1.0, AGENT, "stop"), (2.0, AGENT, "released")]
    assert done == [Done(stop, 1.0), Done(never, None)]


COUNTER = """
import sys, time
path = sys.argv[sys.argv.index("--out") + 1]
while True:
    with open(path, "a") as file:
        file.write("x")
    time.sleep(0.005)
"""


@contextmanager
def child(role: str, run: Path, out: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process whose command line is that of a role; it writes to `out` without end."""
    module = out.parent / f"{role}.py"
    module.write_text(COUNTER)
    command = [sys.executable, "-m", role, "--run", str(run), "--out", str(out)]
    process = subprocess.Popen(command, cwd=out.parent, stderr=subprocess.DEVNULL)
    try:
        wait_for(lambda: out.exists() and out.stat().st_size > 0)
        yield process
    finally:
        process.kill()
        process.wait()


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


THREADS = """
import threading, time
for _ in range(2):
    threading.Thread(target=time.sleep, args=(60,)).start()
    time.sleep(0.3)
print(flush=True)
"""


def test_a_life_is_as_old_as_its_first_threads() -> None:
    command = [sys.executable, "-c", THREADS]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        life = Life(process.pid)
        assert 0.55 * S < life.age_ns() < 20 * S
        process.kill()
    assert life.age_ns() == 0
    life.release()


def state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def test_only_the_process_of_that_role_and_run_is_found(tmp_path: Path) -> None:
    run = tmp_path / "r1"
    with child("some_role", run, tmp_path / "out") as process:
        assert Lives(run).pids("some_role") == [process.pid]
        assert Lives(run).pids("other_role") == []
        assert Lives(tmp_path / "r").pids("some_role") == []
        process.kill()
        wait_for(lambda: state(process.pid) == "Z")
        assert Lives(run).find("some_role") is None  # dead, and not buried yet


def test_stop_continue_kill_on_a_real_process(tmp_path: Path) -> None:
    with child("some_role", tmp_path / "r1", tmp_path / "out") as process:
        life = Lives(tmp_path / "r1").find("some_role")
        assert life is not None
        life.suffer("stop")
        wait_for(lambda: state(process.pid) == "T")
        life.release()  # undoes the stop
        wait_for(lambda: state(process.pid) != "T")
        again = Lives(tmp_path / "r1").find("some_role")
        assert again is not None
        again.suffer("kill")
        assert process.wait(5) == -signal.SIGKILL
        again.suffer("stop")  # that life is over: nothing happens, to nobody
        again.release()


def test_a_full_disk_is_the_victims_alone_and_goes_away(tmp_path: Path) -> None:
    with child("some_role", tmp_path / "r1", tmp_path / "out") as process:
        before = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
        life = Lives(tmp_path / "r1").find("some_role")
        assert life is not None
        life.suffer("fill")
        assert process.wait(5) == 1  # its write failed, and the child has no answer to that
        assert resource.getrlimit(resource.RLIMIT_FSIZE) == before
        life.release()
    with child("other_role", tmp_path / "r1", tmp_path / "out2") as process:
        found = Lives(tmp_path / "r1").find("other_role")
        assert found is not None
        process.send_signal(signal.SIGSTOP)
        found.suffer("fill")
        assert resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[0] == 0
        found.suffer("empty")
        assert resource.prlimit(process.pid, resource.RLIMIT_FSIZE) == before
        found.release()
        process.send_signal(signal.SIGCONT)


def test_an_interface_is_up_again_whatever_happens(tmp_path: Path) -> None:
    said, ip = tmp_path / "said", tmp_path / "ip"
    ip.write_text(f'#!/bin/sh\necho "$@" >> {said}\n')
    ip.chmod(0o755)
    interface = Interface("tn0", str(ip))
    interface.suffer("cut")
    interface.release()
    interface.release()
    assert said.read_text() == "link set dev tn0 down\nlink set dev tn0 up\n"
