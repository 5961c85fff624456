"""Every process of a run killed or stopped while it goes on: what is left tells all of it, and adds up."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from launcher.summary import PASSED, discrepancies
from recorder.reading import columns, texts
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER
from rtcore.run_dir import RunDir
from tests.system.test_processes import SMALL, finish, running, summary_of, wait_for_ticks

DURATION_S, HZ = 14, 50
VICTIMS = (AGENT, ENV_SERVER, RECORDER, LEARNER)  # the learner last: it takes seconds to come back, and only
# an env server that lives has what it missed
pytestmark = pytest.mark.timeout(120)
SPARE = "agent_service.spare"
QUICK = ("--supervise.first-s", "0.1", "--supervise.stuck-s", "2")


@dataclass(frozen=True)
class Finished:
    """A run and how it ended.

    Attributes:
        spares: those that were there before the agent's lives ended, and each next life of it.
    """

    path: Path
    output: str
    code: int
    summary: dict[str, Any]
    spares: list[tuple[int, int]]


def pid_of(run: Path, process: str, limit_s: float = 10.0) -> int:
    """The process of this life, as soon as there is one."""
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        found = subprocess.run(
            ["pgrep", "-f", "--", f"-m {process} --run {run} "], capture_output=True, text=True, check=False
        )
        if found.stdout.split():
            return int(found.stdout.split()[0])
        time.sleep(0.02)
    raise AssertionError(f"no {process}")


def kill_each(run: Path) -> Finished:
    """A run in which each process is killed once, and then the agent stopped for longer than `stuck_s`."""
    spares = []
    settings = (*SMALL, *QUICK, "--duration-s", str(DURATION_S), "--run-dir", str(run))
    with running("run", "pointmass", *settings) as process:
        wait_for_ticks(run, process)
        for victim in VICTIMS:
            time.sleep(1.2)
            spares += [pid_of(run, SPARE)] if victim == AGENT else []
            os.kill(pid_of(run, victim), signal.SIGKILL)
        second = pid_of(run, AGENT)
        time.sleep(2.0)
        spares.append(pid_of(run, SPARE))
        os.kill(second, signal.SIGSTOP)
        third = next_life(run, second)
        output = finish(process, 60)
    lives = [(spares[0], second), (spares[1], third)]
    return Finished(run, output, process.returncode, summary_of(run), lives)


def next_life(run: Path, pid: int) -> int:
    """The agent after that one."""
    while (found := pid_of(run, AGENT)) == pid:
        time.sleep(0.02)
    return found


def kill_twice(run: Path) -> Finished:
    """A run whose agent dies more often than allowed, for the first time together with its spare."""
    settings = (*SMALL, "--supervise.limit", "1", "--duration-s", "60", "--run-dir", str(run))
    with running("run", "pointmass", *settings, "--no-record") as process:
        wait_for_ticks(run, process)
        first, spare = pid_of(run, AGENT), pid_of(run, SPARE)
        for pid in (spare, first):
            os.kill(pid, signal.SIGKILL)
        second = next_life(run, first)
        os.kill(second, signal.SIGKILL)
        output = finish(process, 30)
    return Finished(run, output, process.returncode, summary_of(run), [(spare, second)])


def play(home: Path) -> tuple[Finished, Finished]:
    with ThreadPoolExecutor(2) as pool:
        each, twice = pool.submit(kill_each, home / "each"), pool.submit(kill_twice, home / "twice")
        return each.result(), twice.result()


@pytest.fixture(scope="module")
def both(played: Callable[[str], Any]) -> tuple[Finished, Finished]:
    found: tuple[Finished, Finished] = played("test_killed")
    return found


@pytest.fixture
def finished(both: tuple[Finished, Finished]) -> Finished:
    return both[0]


@pytest.fixture
def given_up(both: tuple[Finished, Finished]) -> Finished:
    return both[1]


def test_the_run_goes_on_to_its_end(finished: Finished) -> None:
    assert finished.code == 0, finished.output
    assert finished.summary["ended"] == "duration"
    assert finished.summary["forced"] == []


def test_each_death_and_each_restart_is_told_once(finished: Finished) -> None:
    killed, again = -signal.SIGKILL, None
    told = [(one["process"], one["what"], one["code"]) for one in finished.summary["supervision"]]
    expected = [(name, "died", killed) for name in VICTIMS]
    assert told[::2] == [*expected, (AGENT, "stuck", killed)]
    assert told[1::2] == [(name, "restarted", again) for name, _, _ in told[::2]]
    assert finished.summary["restarts"] == {ENV_SERVER: 1, AGENT: 2, LEARNER: 1, RECORDER: 1}
    instants = [one["at_s"] for one in finished.summary["supervision"]]
    assert instants == sorted(instants)
    assert instants[0] > 0 and instants[-1] < DURATION_S
    assert f"{ENV_SERVER} died (signal SIGKILL); it is started again in 0.1 s" in finished.output


def test_each_next_life_of_the_agent_is_a_spares(finished: Finished) -> None:
    (first, second), (another, third) = finished.spares
    assert (first, another) == (second, third)
    assert first != another
    left = ["pgrep", "-f", "--", f"--run {finished.path} "]
    assert subprocess.run(left, capture_output=True, text=True, check=False).stdout == ""


def test_the_recording_has_all_of_it(finished: Finished) -> None:
    _, lines = texts(finished.path / "recording.rrd", "/log")
    for process in PROCESSES:
        died = f"[launcher] {process} died (signal SIGKILL); it is started again in 0.1 s"
        assert lines.count(died) == 1, lines
        again = f"[launcher] {process} is started again" + " from its spare" * (process == AGENT)
        assert lines.count(again) == 1 + (process == AGENT), lines
    assert lines.count("[launcher] agent_service hung and was killed; it is started again in 0.2 s") == 1
    ticks, _ = columns(finished.path / "recording.rrd", "/env/reward")
    assert len(ticks) == len(set(ticks.tolist()))
    assert (np.diff(ticks) >= 1).all()


def test_its_counts_reconcile(finished: Finished) -> None:
    summary = finished.summary
    assert discrepancies(summary) == []
    passed = {**summary["deadlines"], "ticks": summary["ticks"]}
    assert sum(passed[name] for name in PASSED) == DURATION_S * HZ
    assert passed["down"] > 0
    assert summary["policies"]["last_version"] == summary["policies"]["published"]
    # What the env server had not sent yet dies with it: a batch, and the steps after a miss that it judges.
    assert 0 <= summary["transitions"]["lost"] <= HZ


def test_every_life_of_a_process_left_its_counters(finished: Finished) -> None:
    found = [stats.process for stats in RunDir.open(finished.path).read_final_stats()]
    assert {process: found.count(process) for process in PROCESSES} == {
        ENV_SERVER: 2,
        AGENT: 3,
        LEARNER: 2,
        RECORDER: 2,
    }


def test_a_process_that_dies_more_often_than_allowed_ends_the_run_loudly(given_up: Finished) -> None:
    assert given_up.code == 1
    gave_up = "agent_service died 2 times in a row (2 x signal SIGKILL)"
    assert f"{gave_up}: the run ends" in given_up.output
    assert f"tenuto: {gave_up}; its last lines:" in given_up.output
    ((spare, second),) = given_up.spares
    assert spare != second
    assert f"{AGENT} is started again\n" in given_up.output
    summary = given_up.summary
    assert summary["ended"] == gave_up
    assert summary["forced"] == []
    assert [one["what"] for one in summary["supervision"]] == ["died", "restarted", "died", "gave_up"]
