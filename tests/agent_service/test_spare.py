"""An agent's spare, as a process: what it waits for, and what becomes of it."""

from __future__ import annotations

import fcntl
import gc
import io
import json
import os
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from agent_service import spare
from launcher.chaos.faults import Life, Lives
from launcher.starting import process_command, spare_command
from rtcore.channels import AGENT
from rtcore.config import RunConfig
from rtcore.run_dir import RunDir

S = 1_000_000_000
NUMBER = 5
# Starts a spare with the pipe that it inherited as stdin, and is the only one to hold the other end.
PARENT = """
import os, subprocess, sys
reading = int(sys.argv[1])
print(subprocess.Popen(sys.argv[2:], stdin=reading).pid, flush=True)
os.close(reading)
input()
"""


class Spare:
    """A spare of the run. What it prints while it waits is in a file of its own."""

    def __init__(self, run: RunDir, name: str, *options: str) -> None:
        self.command = process_command(AGENT, run.path, supervisor=os.getpid())
        self.said = run.path / f"{name}.said"
        command = [sys.executable, *options, *spare_command(self.command)[1:]]
        with self.said.open("wb") as said:
            self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=said, stderr=said)
        assert self.process.stdin is not None
        self.stdin = self.process.stdin

    def order(self, text: str) -> None:
        with self.stdin:
            self.stdin.write(text.encode())

    def ended(self) -> tuple[int, str]:
        return self.process.wait(20), self.said.read_text()


def wait_for(condition: Callable[[], bool], limit_s: float = 20.0) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, "never came"
        time.sleep(0.005)


def wait_until_loaded(*pipes: int) -> None:
    """A blank before the order, to the writing ends; who has read it waits for the rest."""
    for pipe in pipes:
        os.write(pipe, b" ")
    wait_for(lambda: all(fcntl.ioctl(pipe, termios.FIONREAD, bytes(4)) == bytes(4) for pipe in pipes))


def threads(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunDir:
    return RunDir.create(tmp_path_factory.mktemp("spare") / "run", RunConfig())


@pytest.fixture(scope="module")
def spares(run: RunDir) -> Iterator[list[Spare]]:
    """All at once: each has to load first."""
    found = [Spare(run, "first", "-X", "importtime"), *(Spare(run, f"{i}") for i in range(1, NUMBER))]
    try:
        wait_until_loaded(*(one.stdin.fileno() for one in found))
        yield found
    finally:
        for one in found:
            one.process.kill()
            one.process.wait(5)
            one.stdin.close()


def test_it_becomes_the_agent(run: RunDir, spares: list[Spare]) -> None:
    one, output = spares[0], run.logs_dir / "agent_service.out"
    pid = one.process.pid
    assert threads(pid) == 1
    assert Lives(run.path).pids(AGENT) == []  # nobody takes it for one
    before, said = time.monotonic_ns(), one.said.read_text()
    output.write_text("the life before\n")
    one.order(json.dumps({"command": one.command, "output": str(output)}) + "\n")
    wait_for(lambda: run.log_path(AGENT).exists() and "collector" in run.log_path(AGENT).read_text())
    assert Lives(run.path).pids(AGENT) == [pid]
    files = [Path(f"/proc/{pid}/fd/{number}").readlink() for number in range(3)]
    assert files == [Path(os.devnull), output, output]
    wait_for(lambda: threads(pid) > 1)
    life = Life(pid)
    assert life.age_ns() <= time.monotonic_ns() - before + S // 50  # the system counts in steps of 10 ms
    life.release()
    one.process.send_signal(signal.SIGTERM)
    assert one.process.wait(20) == 0
    assert one.said.read_text() == said
    assert output.read_text() == "the life before\n"  # and nothing was left to import


@pytest.mark.parametrize(
    ("index", "line", "complaint"),
    [
        (1, "what?", "JSONDecodeError("),
        (2, '{"command": ["python", "agent.py"], "output": "/dev/null"}', "'-m' is not in list"),
    ],
)
def test_a_bad_order_is_one_line(index: int, line: str, complaint: str, spares: list[Spare]) -> None:
    spares[index].order(f"{line}\n")
    code, said = spares[index].ended()
    assert code == 1  # and not 2, after which nobody is started again
    assert said.startswith("agent_service: its spare cannot take over: ") and complaint in said
    assert said.count("\n") == 1


def test_without_an_order_it_ends_silently(spares: list[Spare]) -> None:
    spares[3].stdin.close()
    assert spares[3].ended() == (0, "")


def test_an_interrupt_ends_it_silently(spares: list[Spare]) -> None:
    spares[4].process.send_signal(signal.SIGINT)
    assert spares[4].ended() == (-signal.SIGINT, "")


def test_once_it_is_somebody_an_interrupt_is_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []

    def run_process(role: str, serve: object, arguments: list[str]) -> int:
        found.append((role, arguments, signal.getsignal(signal.SIGINT), gc.isenabled()))
        return 7

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("os.putenv", lambda name, value: None)
    monkeypatch.setattr("sys.stdin", io.StringIO("{}\n"))
    monkeypatch.setattr("agent_service.spare._obey", lambda line: ["--run", "r"])
    monkeypatch.setattr("rtcore.process.run_process", run_process)
    try:
        assert spare.main() == 7
    finally:
        gc.enable()
    assert found == [(AGENT, ["--run", "r"], before, False)]


def test_it_goes_with_its_parent(run: RunDir) -> None:
    reading, writing = os.pipe()
    words = [sys.executable, "-c", PARENT, str(reading), *spare_command(process_command(AGENT, run.path))]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=(reading, writing)
    ) as it:
        os.close(reading)
        try:
            assert it.stdout is not None
            descriptor = os.pidfd_open(int(it.stdout.readline()))
            wait_until_loaded(writing)
        finally:
            os.close(writing)
            it.kill()
    assert select.select([descriptor], [], [], 1.0)[0]  # it has ended
    os.close(descriptor)
