"""Orders to a fleet, over the in-memory bus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

from launcher import control
from launcher.cli import run_command
from rtcore import cast
from rtcore.bus import Bus
from rtcore.clock import VirtualClock
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Command, CommandReply
from rtcore.run_dir import RunDir
from tests.launcher.ledgers import CONFIG, FLEET


class Stage:
    """A run's directory, and processes that answer: each order is noted with who got it."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.run = RunDir.create(path, FLEET)
        self.hub, self.clock = MemoryHub(), VirtualClock()
        self.orders: list[tuple[str, str]] = []
        self.peers: list[object] = []
        monkeypatch.setattr(control, "open_bus", self._open)

    def serve(self, *names: str, ok: bool = True) -> None:
        for name in names:

            def answer(command: Command, name: str = name) -> CommandReply:
                self.orders.append((name, command.verb))
                return CommandReply(id=command.id, ok=ok, text=f"{name} says so")

            self.hub.bus(name, self.clock).serve(name, answer)

    def alive(self, *names: str) -> None:
        for name in names:
            self.hub.bus(name, self.clock).declare_alive(name)

    def tell(self, verb: str) -> int:
        return run_command([verb, "--run-dir", str(self.run.path)])

    def _open(self, name: str, *arguments: object, **more: object) -> AbstractContextManager[Bus]:
        self.peers.append(more["peers"])

        @contextmanager
        def opened() -> Iterator[Bus]:
            yield self.hub.bus(name, self.clock)

        return opened()


@pytest.fixture
def stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stage:
    return Stage(tmp_path / "r1", monkeypatch)


def test_stop_goes_to_all_env_servers(stage: Stage, capsys: pytest.CaptureFixture[str]) -> None:
    stage.serve(*cast.names(FLEET))
    assert stage.tell("stop") == 0
    assert stage.orders == [(f"env_server.{i}", "stop") for i in range(3)]
    said = capsys.readouterr().out.splitlines()
    assert said == [f"env_server.{i}: env_server.{i} says so" for i in range(3)]
    assert stage.peers == [cast.names(FLEET)]


def test_who_does_not_answer_keeps_no_other_from_its_order(
    stage: Stage, capsys: pytest.CaptureFixture[str]
) -> None:
    stage.serve("env_server.0", "env_server.2")
    stage.alive("env_server.1")
    assert stage.tell("stop") == 1
    assert stage.orders == [("env_server.0", "stop"), ("env_server.2", "stop")]
    assert capsys.readouterr().err == (
        f"tenuto: env_server.1 does not answer in {stage.run.path}: is the run still going?\n"
    )


def test_who_is_not_there_is_no_failure_if_another_one_is(
    stage: Stage, capsys: pytest.CaptureFixture[str]
) -> None:
    stage.serve("env_server.0", "env_server.2")
    assert stage.tell("stop") == 0
    assert stage.orders == [("env_server.0", "stop"), ("env_server.2", "stop")]
    said = capsys.readouterr()
    assert said.out.splitlines() == [
        "env_server.0: env_server.0 says so",
        "env_server.2: env_server.2 says so",
        "env_server.1: is not there: it has ended, or is between two lives; then stop again",
    ]
    assert said.err == ""


def test_nobody_there_is_a_failure(stage: Stage, capsys: pytest.CaptureFixture[str]) -> None:
    assert stage.tell("stop") == 1
    silence = f"does not answer in {stage.run.path}: is the run still going?"
    assert capsys.readouterr().err == f"tenuto: {'; '.join(f'env_server.{i} {silence}' for i in range(3))}\n"


def test_a_refusal_names_who_refused(stage: Stage, capsys: pytest.CaptureFixture[str]) -> None:
    stage.serve("env_server.0", "env_server.2")
    stage.serve("env_server.1", ok=False)
    assert stage.tell("stop") == 1
    assert len(stage.orders) == 3
    assert capsys.readouterr().err == "tenuto: env_server.1: env_server.1 says so\n"


def test_an_order_to_the_learner_is_one(stage: Stage) -> None:
    stage.serve(*cast.names(FLEET))
    assert stage.tell("hold") == 0
    assert stage.orders == [("learner", "hold")]


def test_status_lists_every_process(stage: Stage, capsys: pytest.CaptureFixture[str]) -> None:
    names = cast.names(FLEET)
    stage.serve(*(name for name in names if name != "agent_service.1"))
    assert stage.tell("status") == 0
    rows = capsys.readouterr().out.splitlines()[-len(names) :]
    assert [row.split()[0] for row in rows] == list(names)
    assert "does not answer" in rows[names.index("agent_service.1")]
    assert "says so" in rows[names.index("agent_service.2")]


def test_one_environment_is_asked_as_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stage = Stage(tmp_path / "fleet", monkeypatch)
    stage.run = RunDir.create(tmp_path / "one", CONFIG)
    stage.serve("env_server")
    assert stage.tell("stop") == 0
    assert stage.orders == [("env_server", "stop")]
    assert capsys.readouterr().out == "env_server: env_server says so\n"
