"""When there is a spare, and what it is told; `cat` stands in for one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from launcher.spares import RETRY_S, SETTLED_S, Spares
from launcher.starting import process_command, spare_command

ROLE = "some_role"
COMMAND = ["python", "-m", ROLE, "--run", "r"]


class Yard:
    """Starts spares on a clock of its own; what each is told is in a file of its own."""

    def __init__(self, directory: Path, command: tuple[str, ...] = ("cat",)) -> None:
        self.directory, self.command = directory, command
        self.started: list[subprocess.Popen[bytes]] = []
        self.refused = 0
        self.spares = Spares((ROLE,), self.start)

    def start(self, role: str) -> subprocess.Popen[bytes]:
        assert role == ROLE
        if self.refused:
            self.refused -= 1
            raise OSError("no memory")
        with (self.directory / f"{len(self.started)}").open("wb") as output:
            self.started.append(subprocess.Popen(self.command, stdin=subprocess.PIPE, stdout=output))
        return self.started[-1]

    def take(self) -> subprocess.Popen[bytes] | None:
        return self.spares.take(ROLE, COMMAND, self.directory / "out")

    def kill(self) -> None:
        """The newest one is killed by somebody else."""
        self.started[-1].send_signal(signal.SIGKILL)
        os.waitid(os.P_PID, self.started[-1].pid, os.WEXITED | os.WNOWAIT)  # left for its owner to bury


@pytest.fixture
def yard(tmp_path: Path) -> Iterator[Yard]:
    found = Yard(tmp_path)
    yield found
    found.spares.end()
    for process in found.started:
        process.wait(5)


def test_it_comes_once_when_the_last_start_of_its_role_is_some_time_ago(yard: Yard) -> None:
    for now_s in (100.0, 102.0):  # of a fleet two start
        yard.spares.began(ROLE, now_s)
        yard.spares.began("other_role", now_s)
    for now_s in (102.0, 102.0 + SETTLED_S - 0.01):
        yard.spares.tend(now_s)
    assert yard.started == []
    for now_s in (102.0 + SETTLED_S, 200.0, 300.0):
        yard.spares.tend(now_s)
    assert len(yard.started) == 1


def test_it_is_told_what_to_become_and_another_one_comes(yard: Yard) -> None:
    yard.spares.tend(100.0)
    taken = yard.take()
    assert taken is yard.started[0]
    assert taken.wait(5) == 0  # the end of the order is the end of its input
    line = (yard.directory / "0").read_bytes()
    assert line.endswith(b"\n") and line.count(b"\n") == 1
    assert json.loads(line) == {"command": COMMAND, "output": str(yard.directory / "out")}
    yard.spares.began(ROLE, 101.0)
    assert yard.take() is None
    yard.spares.tend(101.0 + SETTLED_S)
    assert len(yard.started) == 2
    assert yard.take() is yard.started[1]


def test_one_that_was_killed_is_not_taken(yard: Yard) -> None:
    yard.spares.tend(100.0)
    yard.kill()
    assert yard.take() is None
    assert yard.started[0].returncode == -signal.SIGKILL  # buried


def test_one_that_dies_while_it_is_told_is_not_taken(tmp_path: Path) -> None:
    deaf = Yard(tmp_path, ("sh", "-c", "exec <&-; echo deaf; exec sleep 30"))
    deaf.spares.tend(100.0)
    while not (tmp_path / "0").read_bytes():
        assert deaf.started[0].poll() is None
    assert deaf.take() is None
    assert deaf.started[0].returncode == -signal.SIGKILL


def test_who_keeps_dying_is_not_tried_all_the_time(yard: Yard) -> None:
    now_s = 100.0
    for count in (1, 2, 3):
        yard.spares.tend(now_s)
        assert len(yard.started) == count
        yard.kill()
        yard.spares.tend(now_s + 1.0)  # seen
        yard.spares.began(ROLE, now_s + 2.0)  # does not make it any sooner
        yard.spares.tend(now_s + 1.0 + RETRY_S - 0.01)
        assert len(yard.started) == count
        now_s += 1.0 + RETRY_S


def test_a_system_that_refuses_it_is_asked_again_later(yard: Yard) -> None:
    yard.refused = 1
    yard.spares.tend(100.0)
    yard.spares.tend(100.0 + RETRY_S - 0.01)
    assert yard.started == [] and not yard.refused
    yard.spares.tend(100.0 + RETRY_S)
    assert len(yard.started) == 1


def test_who_still_waits_at_the_end_is_killed(yard: Yard) -> None:
    yard.spares.tend(100.0)
    yard.spares.end()
    assert yard.started[0].returncode == -signal.SIGKILL
    assert yard.take() is None


def test_its_command_line_is_not_taken_for_that_of_the_process() -> None:
    command = process_command("some_role.11", Path("r"), supervisor=12345)
    spare = spare_command(command)
    assert spare[1:3] == ["-m", "some_role.spare"]
    assert spare[3:] == command[3:] == ["--run", "r", "--index", "11", "--supervised", "12345"]
