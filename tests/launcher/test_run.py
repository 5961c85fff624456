"""The real system on the cheap world, from the outside: started, asked, held, interrupted."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from launcher.process import _join
from rtcore.config import ConfigError, RunConfig
from rtcore.run_dir import RunDir
from tests.launcher.commands import command_line, tenuto


@dataclass
class Finished:
    """A run that was interrupted once."""

    path: Path
    code: int
    lines: list[str]
    ended_after_s: float
    answers: dict[str, subprocess.CompletedProcess[str]]
    summary: dict[str, Any]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    root = tmp_path_factory.mktemp("run")
    path = root / "r1"
    arguments = ["run", "pointmass", "--duration-s", "0", "--run-dir", str(path), "--seed", "3"]
    with subprocess.Popen(command_line(*arguments), cwd=root, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line.rstrip())
            if "Hz" in line:
                break
        answers = {
            verb: tenuto(verb, "--run-dir", str(path), cwd=root) for verb in ("status", "hold", "resume")
        }
        began = time.monotonic()
        process.send_signal(signal.SIGINT)
        lines += [line.rstrip() for line in process.stdout]
        code = process.wait(timeout=20)
        ended_after_s = time.monotonic() - began
    return Finished(
        path, code, lines, ended_after_s, answers, json.loads((path / "summary.json").read_text())
    )


def test_one_interrupt_ends_it_in_order_within_five_seconds(finished: Finished) -> None:
    assert finished.code == 0
    assert finished.ended_after_s <= 5.0
    assert finished.summary["ended"] == "interrupted"
    assert finished.summary["forced"] == []


def test_all_files_are_complete(finished: Finished) -> None:
    run_dir = RunDir.open(finished.path)
    assert run_dir.recording_path.stat().st_size > 0
    assert len(run_dir.read_final_stats()) == 4
    assert all(stats.final for stats in run_dir.read_final_stats())
    assert all(0 < stats.beat_ns <= stats.at_ns for stats in run_dir.read_final_stats())
    assert run_dir.config().seed == 3
    assert not (finished.path / "link").exists()


def test_its_counts_reconcile(finished: Finished) -> None:
    assert "reconcile" in "".join(line for line in finished.lines if "counts" in line)
    assert finished.summary["ticks"] > 0
    assert finished.summary["transitions"]["lost"] == 0
    assert finished.summary["policies"]["published_in_hold"] == 0


def test_it_answers_its_operator(finished: Finished) -> None:
    assert [answer.returncode for answer in finished.answers.values()] == [0, 0, 0]
    for process in ("env_server", "agent_service", "learner", "recorder"):
        assert process in finished.answers["status"].stdout
    assert "does not answer" not in finished.answers["status"].stdout
    assert finished.summary["operator_holds"] == 1


def test_the_report_can_be_read_again(finished: Finished) -> None:
    again = tenuto("report", str(finished.path), cwd=finished.path.parent)
    assert again.returncode == 0
    assert "seed 3" in again.stdout
    assert f"tenuto view {finished.path}" in again.stdout.replace("\n", "")


def test_one_process_alone_makes_the_run_and_ends_by_itself(tmp_path: Path) -> None:
    path = tmp_path / "r1"
    arguments = ["pointmass", "--duration-s", "0.3", "--env.start-wait-s", "0"]
    done = tenuto("env", *arguments, "--run-dir", str(path), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (stats,) = RunDir.open(path).read_final_stats()
    assert stats.counters["ticks"] + stats.counters["skipped"] == 30
    assert stats.counters["missed"] == stats.counters["missed.agent_absent"]


def test_processes_share_a_run_only_with_the_same_settings(tmp_path: Path) -> None:
    path = tmp_path / "r1"
    config = RunConfig(seed=1)
    assert _join(path, config).path == path
    assert _join(path, config).path == path
    with pytest.raises(ConfigError, match=r"run_dir = .*: has a run\.toml with other settings"):
        _join(path, RunConfig(seed=2))
