"""Deaths that do not end the run, and those that do."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from launcher import run_delay
from launcher.children import Children
from launcher.restarts import Happening, Restarts
from launcher.run_delay import Thread
from launcher.supervisor import End, Interrupts, Supervisor
from launcher.vitals import Vitals
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER
from rtcore.config import SuperviseConfig
from tests.launcher.ledgers import ledger
from tests.launcher.test_supervisor import children, ended, never, once, supervise

QUICK = SuperviseConfig(limit=2, first_s=0.05, most_s=0.1)


def lives(directory: Path, process: str) -> list[str]:
    return (directory / f"{process}.lives").read_text().splitlines()


def pid(directory: Path, process: str) -> int:
    return int((directory / f"{process}.ready").read_text())


def carry_on(
    directory: Path,
    behaviours: dict[str, list[str]],
    config: SuperviseConfig,
    look: Callable[[Interrupts, list[Happening]], None],
    vitals: Vitals | None = None,
) -> tuple[End, list[Happening]]:
    """Supervise four fakes with restarts; `look` is called at each poll."""
    told: list[Happening] = []
    fakes = Supervisor(
        children(directory, behaviours), directory,
        restarts=Restarts(config), vitals=vitals, tell=told.append,
    )  # fmt: skip
    interrupts, limit_s = Interrupts(), time.monotonic() + 20

    def poll(waiting_for: frozenset[str]) -> None:
        assert time.monotonic() < limit_s
        look(interrupts, told)

    with fakes.started():
        return fakes.supervise(interrupts, poll), told


def nothing(interrupts: Interrupts, told: list[Happening]) -> None:
    pass


def until_back(interrupts: Interrupts, told: list[Happening]) -> None:
    """Interrupt when somebody was started again."""
    interrupts.count = int(any(one.what == "restarted" for one in told))


def whats(told: list[Happening], process: str) -> list[tuple[str, int | None]]:
    return [(one.what, one.code) for one in told if one.process == process]


@pytest.mark.parametrize(("process", "code"), [(LEARNER, 3), (AGENT, 0), (ENV_SERVER, 1)])
def test_who_dies_lives_again_and_the_run_goes_on(process: str, code: int, tmp_path: Path) -> None:
    end, told = carry_on(tmp_path, {process: ["ends", str(code), "1"]}, QUICK, until_back)
    assert end == End("interrupted")
    assert whats(told, process) == [("died", code), ("restarted", None)]
    assert told[1].at_ns - told[0].at_ns >= 50_000_000
    assert ended(tmp_path)[0] == process and set(ended(tmp_path)[1:]) <= set(PROCESSES)


def test_who_is_killed_lives_again(tmp_path: Path) -> None:
    killed: list[int] = []

    def look(interrupts: Interrupts, told: list[Happening]) -> None:
        if not killed and (tmp_path / f"{RECORDER}.ready").exists():
            killed.append(pid(tmp_path, RECORDER))
            os.kill(killed[0], signal.SIGKILL)
        until_back(interrupts, told)

    end, told = carry_on(tmp_path, {}, QUICK, look)
    assert end == End("interrupted")
    assert whats(told, RECORDER) == [("died", -signal.SIGKILL), ("restarted", None)]


def test_who_dies_at_once_every_time_ends_the_run_loudly(tmp_path: Path) -> None:
    end, told = carry_on(tmp_path, {LEARNER: ["ends", "3"]}, QUICK, nothing)
    assert end.reason == "failed"
    (failure,) = end.failures
    assert str(failure) == "learner died 3 times in a row (3 x exit code 3)"
    assert failure.output == "learner: no more\n" * 2 + "learner: no more"
    died, again = ("died", 3), ("restarted", None)
    assert whats(told, LEARNER) == [died, again, died, again, died, ("gave_up", 3)]
    assert told[-1].text == f"{failure}: the run ends"
    assert ended(tmp_path) == [LEARNER] * 3 + [ENV_SERVER, AGENT, RECORDER]


def test_wrong_input_is_not_tried_twice(tmp_path: Path) -> None:
    end = supervise(tmp_path, {AGENT: ["ends", "2"]}, never, Restarts(QUICK))
    assert end.reason == "failed"
    assert [str(one) for one in end.failures] == [
        "agent_service cannot work with what it was given (exit code 2)"
    ]


def test_the_env_servers_own_end_is_the_end_though_somebody_is_between_two_lives(tmp_path: Path) -> None:
    slow = SuperviseConfig(first_s=100.0, most_s=100.0)
    behaviours = {LEARNER: ["ends", "1"], ENV_SERVER: ["leaves"]}

    def look(interrupts: Interrupts, told: list[Happening]) -> None:
        if told:
            (tmp_path / f"{ENV_SERVER}.go").touch()

    began = time.monotonic()
    end, told = carry_on(tmp_path, behaviours, slow, look)
    assert end == End("duration")
    assert whats(told, LEARNER) == [("died", 1)]
    assert time.monotonic() - began < 10
    assert ended(tmp_path)[-2:] == [AGENT, RECORDER]


def test_an_interrupt_between_two_lives_ends_promptly(tmp_path: Path) -> None:
    slow = SuperviseConfig(first_s=100.0, most_s=100.0)

    def look(interrupts: Interrupts, told: list[Happening]) -> None:
        interrupts.count = int(bool(told))

    began = time.monotonic()
    end, told = carry_on(tmp_path, {AGENT: ["ends", "1"]}, slow, look)
    assert end == End("interrupted")
    assert whats(told, AGENT) == [("died", 1)]
    assert time.monotonic() - began < 10
    assert ended(tmp_path) == [AGENT, ENV_SERVER, LEARNER, RECORDER]


def test_who_is_stuck_is_killed_and_lives_again(tmp_path: Path) -> None:
    vitals, began_ns = Vitals(1.0), time.monotonic_ns()

    def look(interrupts: Interrupts, told: list[Happening]) -> None:
        until_back(interrupts, told)
        now_ns = time.monotonic_ns()
        for process in PROCESSES:  # the agent's loop turns once
            beat_ns = began_ns + 1 if process == AGENT else now_ns
            vitals.heard(ledger(process, beat_ns=beat_ns), now_ns)

    end, told = carry_on(tmp_path, {}, QUICK, look, vitals)
    assert end == End("interrupted")
    assert whats(told, AGENT) == [("stuck", -signal.SIGKILL), ("restarted", None)]
    assert {one.process for one in told} == {AGENT}
    assert told[0].text == "agent_service hung and was killed; it is started again in 0.05 s"


def test_who_waits_for_a_core_is_told_of_and_lives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vitals, began_ns = Vitals(1.0), time.monotonic_ns()

    def read(number: int) -> dict[str, Thread]:
        return {str(number): Thread(time.monotonic_ns(), time.monotonic_ns(), runnable=True)}

    monkeypatch.setattr(run_delay, "read", read)

    def look(interrupts: Interrupts, told: list[Happening]) -> None:
        now_ns = time.monotonic_ns()
        interrupts.count = int(bool(told) or now_ns - began_ns > 10_000_000_000)
        for process in PROCESSES:
            beat_ns = began_ns + 1 if process == AGENT else now_ns
            vitals.heard(ledger(process, beat_ns=beat_ns), now_ns)

    end, told = carry_on(tmp_path, {}, QUICK, look, vitals)
    assert end == End("interrupted")
    assert [(one.process, one.what, one.code) for one in told] == [(AGENT, "starved", None)]
    assert told[0].text == "agent_service does not say that its loop turns: it waits for a core"
    assert ended(tmp_path) == list(PROCESSES)  # in order, all of them by themselves


def test_who_cannot_be_started_has_died(tmp_path: Path) -> None:
    told: list[Happening] = []
    commands = {ENV_SERVER: children(tmp_path, {})[ENV_SERVER], AGENT: [str(tmp_path / "agent")]}
    (tmp_path / "agent").write_text("#!/bin/sh\nrm $0\nexit 1\n")  # gone after its first life
    (tmp_path / "agent").chmod(0o755)
    fakes = Supervisor(commands, tmp_path, restarts=Restarts(QUICK), tell=told.append)
    with fakes.started():
        end = fakes.supervise(Interrupts(), lambda waiting_for: None)
    assert end.reason == "failed"
    assert [str(one) for one in end.failures] == [
        "agent_service died 3 times in a row (exit code 1, 2 x exit code 126)"
    ]
    assert "No such file" in told[1].text


def test_a_later_life_has_the_place_of_the_first(tmp_path: Path) -> None:
    """The launcher steps aside once its children are there; those to come must not follow it."""
    here = os.sched_getaffinity(0)
    if len(here) < 2:
        pytest.skip("one core")
    fakes = Children(children(tmp_path, {}), tmp_path)
    with fakes.kept():
        fakes.start(AGENT)
        wait_for_lives(tmp_path, 1)
        try:
            os.sched_setaffinity(0, {max(here)})
            fakes.kill({AGENT})
            fakes.start(AGENT)
            wait_for_lives(tmp_path, 2)
        finally:
            os.sched_setaffinity(0, here)
    first, second = lives(tmp_path, AGENT)
    assert first == second and str(sorted(here)) in first


def wait_for_lives(directory: Path, count: int) -> None:
    limit = time.monotonic() + 10
    path = directory / f"{AGENT}.lives"
    while not path.exists() or len(path.read_text().splitlines()) < count:
        assert time.monotonic() < limit
        time.sleep(0.01)


def test_who_is_killed_while_it_ends_is_told_and_no_failure(tmp_path: Path) -> None:
    told: list[Happening] = []

    def murder(interrupts: Interrupts) -> None:
        once(interrupts)
        os.kill(pid(tmp_path, LEARNER), signal.SIGKILL)

    end = supervise(tmp_path, {}, murder, Restarts(QUICK), tell=told.append)
    assert end == End("interrupted")
    assert whats(told, LEARNER) == [("died", -signal.SIGKILL)]
