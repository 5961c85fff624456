"""The processes of a fleet: who ends the run, who is started again, who gets which signal when."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from launcher import supervisor
from launcher.restarts import Happening, Restarts
from launcher.starting import process_command
from launcher.supervisor import End, Interrupts, OrderlyEnd, Supervisor
from launcher.vitals import Vitals
from rtcore import cast
from rtcore.channels import LEARNER, RECORDER
from rtcore.config import EnvConfig, RunConfig, SuperviseConfig
from tests.launcher.test_supervisor import CHILD, ended

PAIR = cast.names(RunConfig(env=EnvConfig(count=2)))
ENV0, ENV1, AGENT0, AGENT1 = PAIR[:4]
QUICK = SuperviseConfig(limit=1, first_s=0.05, most_s=0.1)
TERM, KILL = signal.SIGTERM, signal.SIGKILL


class Heard(Vitals):
    """Vitals that remember who they were told has gone."""

    def __init__(self) -> None:
        super().__init__(1.0)
        self.departed: list[str] = []

    def gone(self, process: str) -> None:
        """See `Vitals`."""
        super().gone(process)
        self.departed.append(process)


def carry_on(
    directory: Path,
    behaviours: Mapping[str, Sequence[str]],
    look: Callable[[Interrupts, list[Happening]], None],
    vitals: Vitals | None = None,
) -> tuple[End, list[Happening]]:
    """Supervise the six fakes of a fleet of two; `look` is called at each poll while the run goes on."""
    commands = {
        name: [sys.executable, str(CHILD), name, str(directory), *behaviours.get(name, ["obedient"])]
        for name in PAIR
    }
    told: list[Happening] = []
    fakes = Supervisor(commands, directory, restarts=Restarts(QUICK), vitals=vitals, tell=told.append)
    interrupts, limit_s = Interrupts(), time.monotonic() + 20

    def poll(waiting_for: frozenset[str]) -> None:
        assert time.monotonic() < limit_s
        if not waiting_for:
            look(interrupts, told)

    with fakes.started():
        return fakes.supervise(interrupts, poll), told


def all_ready(directory: Path) -> bool:
    return len(list(directory.glob("*.ready"))) == len(PAIR)


def go(directory: Path, process: str) -> None:
    (directory / f"{process}.go").touch()


def test_the_run_ends_when_all_env_servers_have(tmp_path: Path) -> None:
    vitals = Heard()
    polls_alone: list[frozenset[str]] = []

    def look(interrupts: Interrupts, told: list[Happening]) -> None:
        if not all_ready(tmp_path):
            return
        go(tmp_path, ENV0)
        if (tmp_path / "ended").exists():
            polls_alone.append(frozenset(vitals.departed))
        if len(polls_alone) == 4:  # it has ended, and the run went on for 0.15 s
            go(tmp_path, ENV1)

    end, told = carry_on(tmp_path, {ENV0: ["leaves"], ENV1: ["leaves"]}, look, vitals)
    assert end == End("duration")
    assert told == []
    order = ended(tmp_path)
    assert order[:2] == [ENV0, ENV1]
    assert set(order[2:4]) == {AGENT0, AGENT1}
    assert order[4:] == [LEARNER, RECORDER]
    assert polls_alone[-1] == {ENV0}  # nothing is expected of it: it must not be found stuck


def test_an_agent_that_dies_lives_again_alone(tmp_path: Path) -> None:
    def look(interrupts: Interrupts, told: list[Happening]) -> None:
        interrupts.count = int(any(one.what == "restarted" for one in told) and all_ready(tmp_path))

    end, told = carry_on(tmp_path, {AGENT1: ["ends", "3", "1", "6"]}, look)
    assert end == End("interrupted")
    assert [(one.process, one.what, one.code) for one in told] == [
        (AGENT1, "died", 3), (AGENT1, "restarted", None),
    ]  # fmt: skip
    assert told[0].text.startswith("agent_service.1 died (exit code 3)")
    for name in PAIR:
        lives = (tmp_path / f"{name}.lives").read_text().splitlines()
        assert len(lives) <= 1 + (name == AGENT1), name


def test_deaths_count_for_each_process(tmp_path: Path) -> None:
    """Two agents that die once each: with a limit of 1 neither is given up."""
    both = {name: ["ends", "3", "1", "6"] for name in (AGENT0, AGENT1)}

    def look(interrupts: Interrupts, told: list[Happening]) -> None:
        interrupts.count = int(sum(one.what == "restarted" for one in told) == 2)

    end, told = carry_on(tmp_path, both, look)
    assert end == End("interrupted")
    assert sorted((one.process, one.what) for one in told) == [
        (name, what) for name in (AGENT0, AGENT1) for what in ("died", "restarted")
    ]


def test_an_env_server_that_dies_lives_again_though_another_has_ended(tmp_path: Path) -> None:
    def look(interrupts: Interrupts, told: list[Happening]) -> None:
        interrupts.count = int(len(told) == 2)

    end, told = carry_on(tmp_path, {ENV0: ["ends", "0", "1", "6"], ENV1: ["ends", "1", "1", "6"]}, look)
    assert end == End("interrupted")
    assert [(one.process, one.what) for one in told] == [(ENV1, "died"), (ENV1, "restarted")]


def test_the_order_in_time_is_by_role() -> None:
    plan = OrderlyEnd(PAIR, begin_s=100.0, limit_s=10.0)
    everybody = frozenset(PAIR)
    assert plan.due(100.0, everybody) == [(ENV0, TERM), (ENV1, TERM)]
    assert plan.due(100.1, everybody - {ENV0}) == []  # the other one still sends
    assert plan.due(100.2, everybody - {ENV0, ENV1}) == [(AGENT0, TERM), (AGENT1, TERM)]
    assert plan.due(102.9, frozenset({AGENT1, LEARNER, RECORDER})) == []
    assert plan.due(103.0, frozenset({AGENT1, LEARNER, RECORDER})) == [(LEARNER, TERM)]
    assert plan.due(107.0, frozenset({AGENT1, RECORDER})) == [(RECORDER, TERM)]
    assert plan.due(110.0, frozenset({AGENT1})) == [(AGENT1, KILL)]


def test_a_share_of_the_time_is_the_roles() -> None:
    plan = OrderlyEnd(PAIR, begin_s=0.0, limit_s=10.0)
    plan.due(0.0, frozenset(PAIR))
    assert plan.due(1.9, frozenset(PAIR)) == []
    assert plan.due(2.0, frozenset(PAIR)) == [(AGENT0, TERM), (AGENT1, TERM)]


def test_their_command_lines() -> None:
    command = process_command("agent_service.2", Path("r"), supervisor=7, python="python")
    assert command == [
        "python", "-m", "agent_service", "--run", "r", "--index", "2", "--supervised", "7"
    ]  # fmt: skip
    assert process_command(LEARNER, Path("r"), python="python") == ["python", "-m", LEARNER, "--run", "r"]
    assert supervisor.command_for("env_server.0", Path("r"))[1:7] == [
        "-m", "env_server", "--run", "r", "--index", "0"
    ]  # fmt: skip
