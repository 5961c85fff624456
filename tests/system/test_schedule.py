"""A schedule that chooses, and an operator who replaces it, with real processes."""

from __future__ import annotations

import json
import re
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from experiments.follow_runs import explained
from recorder.reading import columns, texts
from tests.launcher.commands import command_line, tenuto

pytestmark = pytest.mark.timeout(120)
AUTO = (
    "chain", "--env.hz", "100", "--env.unit-s", "0.1", "--env.episode-steps", "9",
    "--learner.forecast.l-p", "4",
    "--learner.schedule", "auto", "--learner.schedule.l-f", "8",
)  # fmt: skip
FIXED = ("fixed", "--l-f", "4", "--gamma-f", "0.5")
WRONG = ("fixed", "--l-f", "0")


@dataclass
class Changed:
    """A run that was asked for a wrong schedule and for a right one, and ended some windows later."""

    path: Path
    wrong: subprocess.CompletedProcess[str]
    right: subprocess.CompletedProcess[str]
    windows: list[dict[str, Any]]

    @property
    def recording(self) -> Path:
        return self.path / "recording.rrd"

    @property
    def first(self) -> int:
        """The first window of the new schedule."""
        return next(int(one["m"]) for one in self.windows if one["G"] + one["N"] != 8)


def play(root: Path) -> Changed:
    run, log = root / "run", root / "run" / "logs" / "learner.jsonl"
    arguments = command_line("run", *AUTO, "--duration-s", "60", "--run-dir", str(run), "--record")
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            deadline = time.monotonic() + 40
            while not (log.exists() and "window 0: " in log.read_text()):
                assert process.poll() is None and time.monotonic() < deadline, "the first window is entered"
                time.sleep(0.05)
            with ThreadPoolExecutor(2) as pool:  # a busy machine takes seconds to start each
                wrong, right = pool.map(
                    lambda wanted: tenuto("schedule", *wanted, "--run-dir", str(run), cwd=root),
                    (WRONG, FIXED),
                )
            time.sleep(2.0)  # 20 units: what is left of a window of 8, and windows of 4
            assert tenuto("stop", "--run-dir", str(run), cwd=root).returncode == 0
            output, _ = process.communicate(timeout=40)
        finally:
            process.terminate()  # nothing, if it has ended
    assert process.returncode == 0, output
    return Changed(run, wrong, right, json.loads((run / "summary.json").read_text())["windows"])


@pytest.fixture(scope="module")
def changed(played: Callable[[str], Any]) -> Changed:
    found: Changed = played("test_schedule")
    return found


def test_a_wrong_schedule_is_refused_in_one_line(changed: Changed) -> None:
    assert changed.wrong.returncode == 2
    assert changed.wrong.stdout == ""
    (line,) = changed.wrong.stderr.splitlines()
    for words in ("learner.schedule.l_f", "0", "must be an integer"):
        assert words in line


def test_a_right_one_is_promised_for_the_windows_end(changed: Changed) -> None:
    assert changed.right.returncode == 0, changed.right.stderr
    assert changed.right.stdout == "learner: the schedule will change when the present window has ended\n"


def test_windows_change_where_one_ends(changed: Changed) -> None:
    """Eight units each while `auto` chooses, then four with two of updates; none is cut or left out."""
    windows, first = changed.windows, changed.first
    assert 1 <= first < len(windows) - 1
    assert [one["m"] for one in windows] == list(range(len(windows)))
    assert all(one["t_m"] == 8 * one["m"] and one["G"] + one["N"] == 8 for one in windows[:first])
    assert all((one["G"], one["N"]) == (2, 2) for one in windows[first:])
    assert all(after["t_m"] == one["t_m"] + one["G"] + one["N"] for one, after in pairwise(windows))


def test_the_recording_says_so(changed: Changed) -> None:
    """One line on every window that was chosen, none on the others, and one on the operator's order."""
    lines = texts(changed.recording, "/log")[1]
    orders = [line for line in lines if "operator: " in line]
    unit = changed.windows[changed.first]["t_m"]
    assert orders == [f"[learner] operator: schedule fixed from unit {unit} on"]
    said = explained(changed.recording)
    assert list(said) == list(range(changed.first))
    for one in changed.windows[: changed.first]:
        assert re.match(f"{one['G']} units of update, {one['N']} of hold: ", said[one["m"]])


def test_the_timeline_shows_the_last_window(changed: Changed) -> None:
    for name in ("update", "hold"):
        _, values = columns(changed.recording, f"/learner/schedule/{name}", timeline="run_time")
        assert values[-1, 0] == 2
