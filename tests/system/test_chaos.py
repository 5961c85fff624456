"""`tenuto chaos` on the cheap world: every process has a fault, and every promise is kept."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from recorder import reading
from rtcore.channels import PROCESSES
from rtcore.run_dir import RunDir
from tests.launcher.commands import tenuto

pytestmark = pytest.mark.timeout(120)  # 13 s of run time, and what a busy machine takes to start and to end
# This seed kills learner, env server and agent and stops env server, agent and recorder within 8.5 s: a
# learner that starts again on a busy machine takes 5 s.
SETTINGS = (
    "pointmass", "--env.hz", "100", "--duration-s", "13", "--kills", "6", "--seed", "640",
    "--learner.hidden", "16", "16", "--learner.batch", "32", "--learner.learning-starts", "100",
)  # fmt: skip
Story = tuple[Path, dict[str, Any], str]  # the run, its verdict, what was said


def play(home: Path) -> Story:
    run = home / "run"
    done = tenuto("chaos", *SETTINGS, "--run-dir", str(run), cwd=home, timeout_s=110)
    found = json.loads((run / "chaos.json").read_text())
    assert done.returncode == (0 if found["passed"] else 1), done.stdout + done.stderr
    return run, found, done.stdout


@pytest.fixture(scope="module")
def story(played: Callable[[str], Any]) -> Story:
    found: Story = played("test_chaos")
    return found


def clause(found: dict[str, Any], name: str) -> dict[str, Any]:
    return next(one for one in found["clauses"] if one["name"] == name)


def test_every_process_had_its_fault(story: Story) -> None:
    _, found, _ = story
    assert all(fault["done_at_s"] is not None for fault in found["faults"])
    assert {fault["process"] for fault in found["faults"]} == set(PROCESSES)
    assert Counter(fault["kind"] for fault in found["faults"]) == {"kill": 3, "stop": 3}


@pytest.mark.parametrize(
    "name",
    ["carried out", "transitions", "versions", "policies", "deadlines", "deaths", "report", "recording"],
)
def test_what_does_not_depend_on_the_machine_holds(story: Story, name: str) -> None:
    assert clause(story[1], name)["holds"] is True, clause(story[1], name)


@pytest.mark.parametrize("name", ["pacing", "overruns"])
def test_what_does_is_judged(story: Story, name: str) -> None:
    assert clause(story[1], name)["holds"] is not None  # a busy machine breaks it without any fault


def test_the_verdict_is_on_one_screen(story: Story) -> None:
    run, found, output = story
    screen = output[output.index("chaos in run") :]
    assert all(one["name"] in screen for one in found["clauses"])
    assert str(run.name) in screen
    assert len(screen.splitlines()) <= 40


def test_faults_and_what_was_done_about_them_are_in_the_recording(story: Story) -> None:
    run, found, _ = story
    _, lines = reading.texts(RunDir(run).recording_path, "/log")
    killed = Counter(fault["process"] for fault in found["faults"] if fault["kind"] == "kill")
    told = [line for line in lines if line.startswith("[launcher]")]
    assert sum("is started again" in line for line in told) >= 1, told
    assert {name for name in killed if any(f"{name} died" in line for line in told)} == set(killed)
