"""Real processes over real Zenoh: a run from the command line, judged by what it left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from launcher.summary import discrepancies
from recorder.reading import columns, spans, texts
from rtcore.run_dir import RunDir

pytestmark = pytest.mark.timeout(120)  # others are played beside each
UNIT_NS = 500_000_000
SMALL = (
    "--env.hz", "50", "--env.unit-s", "0.5", "--env.episode-steps", "40", "--learner.learning-starts", "30",
    "--learner.hidden", "16", "16", "--learner.batch", "32",
    "--learner.schedule.l-f", "4", "--learner.schedule.gamma-f", "0.5",
)  # fmt: skip
# Windows of 4 units of 0.5 s: 2 update, 2 hold.


def tenuto(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "launcher", *arguments]


@contextmanager
def running(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        tenuto(*arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait(20)


def finish(process: subprocess.Popen[str], timeout_s: float) -> str:
    output, _ = process.communicate(timeout=timeout_s)
    return output


def summary_of(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "summary.json").read_text())
    return found


def wait_for_ticks(run: Path, process: subprocess.Popen[str], timeout_s: float = 40.0) -> None:
    """Until the env server says that it ticks."""
    log = run / "logs" / "env_server.jsonl"
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if log.exists() and " Hz" in log.read_text():
            return
        assert process.poll() is None, finish(process, 5)
        time.sleep(0.05)
    raise AssertionError(f"no tick within {timeout_s} s")


def play_whole(home: Path) -> Path:
    """Ten seconds of point mass with all four processes."""
    run = home / "run"
    done = subprocess.run(
        tenuto("run", "pointmass", "--duration-s", "10", "--run-dir", str(run), *SMALL),
        capture_output=True, text=True, timeout=90, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return run


def play_held(home: Path) -> Path:
    """A run that an operator holds and resumes, after two seconds each: four units, and so four policies."""
    run = home / "run"
    always = ("--learner.schedule.gamma-f", "1.0", "--duration-s", "60", "--run-dir", str(run))
    with running("run", "pointmass", *SMALL, *always) as process:
        wait_for_ticks(run, process)
        time.sleep(2.0)
        order(run, "hold")
        time.sleep(2.0)
        order(run, "resume")
        time.sleep(2.0)
        assert "gradient steps" in order(run, "status")
        order(run, "stop")
        finish(process, 30)
        assert process.returncode == 0
    return run


def play_interrupted(home: Path) -> Path:
    run = home / "run"
    with running("run", "pointmass", *SMALL, "--duration-s", "60", "--run-dir", str(run)) as process:
        wait_for_ticks(run, process)
        time.sleep(2.0)
        begin = time.monotonic()
        process.send_signal(signal.SIGINT)
        output = finish(process, 20)
        took_s = time.monotonic() - begin
    assert process.returncode == 0, output
    assert took_s < 7.0, output  # 5 s are promised; 2 more for a busy machine
    return run


def play_interrupted_twice(home: Path) -> Path:
    run = home / "run"
    with running("run", "pointmass", *SMALL, "--duration-s", "60", "--run-dir", str(run)) as process:
        wait_for_ticks(run, process)
        process.send_signal(signal.SIGINT)
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        finish(process, 10)
    assert process.returncode == 130
    return run


def play_sequence(sequence: Sequence[str], home: Path) -> Path:
    """Each process by its own command, in that order; the first one makes the run.

    A world that is first has waited for the others, and goes on without them, when the next one starts.
    """
    run, duration_s = home / "run", 14 if sequence[0] == "env" else 10  # then the learner comes late
    settings = ("--env.start-wait-s", "1.5", "--duration-s", str(duration_s), "--run-dir", str(run))
    started: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for command in sequence:
            arguments = tenuto(command, *(("pointmass", *SMALL, *settings) if not started else settings[-2:]))
            started[command] = subprocess.Popen(arguments)
            time.sleep(3.0 if command == "env" else 1.0)
        assert started["env"].wait(45) == 0
        for command in ("agent", "learn", "record"):
            started[command].send_signal(signal.SIGTERM)
            assert started[command].wait(20) == 0
    finally:
        for process in started.values():
            process.kill()
    return run


STORIES: dict[str, Callable[[Path], Path]] = {
    "env_last": partial(play_sequence, ("record", "learn", "agent", "env")),
    "env_first": partial(play_sequence, ("env", "agent", "record", "learn")),
    "held_run": play_held,
    "whole_run": play_whole,
    "interrupted_run": play_interrupted,
    "twice_interrupted_run": play_interrupted_twice,
}


def story(name: str) -> Any:
    """The fixture of a story: its run."""

    @pytest.fixture(name=name, scope="module")
    def told(played: Callable[[str], Any]) -> Path:
        run: Path = played(f"test_processes.{name}")
        return run

    return told


env_last, env_first, held_run, whole_run, interrupted_run, twice_interrupted_run = map(story, STORIES)


def test_the_summary_reconciles_and_nothing_is_lost(whole_run: Path) -> None:
    summary = summary_of(whole_run)
    assert discrepancies(summary) == []
    assert summary["ended"] == "duration"
    assert summary["ticks"] + summary["deadlines"]["skipped"] == 500
    assert summary["transitions"]["lost"] == 0
    assert summary["policies"]["published_in_hold"] == 0
    assert summary["policies"]["published"] >= 5
    assert summary["learner"]["gradient_steps"] > 100
    assert summary["windows"] == [{"m": m, "t_m": 4 * m, "G": 2, "N": 2} for m in range(5)]
    assert summary["recorder"]["dropped"] == 0
    assert summary["messages"]["rejected"] == 0
    assert summary["restarts"] == {"env_server": 0, "agent_service": 0, "learner": 0, "recorder": 0}


def test_the_recording_alone_shows_phases_of_the_configured_lengths(whole_run: Path) -> None:
    phases = spans(whole_run / "recording.rrd")
    assert [phase.state for phase in phases] == ["update", "hold"] * 5
    assert [phase.start_ns for phase in phases[1:]] == [2 * UNIT_NS * i for i in range(1, 10)]
    assert 0 <= phases[0].start_ns < UNIT_NS // 2  # 0, unless a busy machine kept the learner beyond T0


def test_the_recording_alone_shows_new_policies_in_update_phases_only(whole_run: Path) -> None:
    recording = whole_run / "recording.rrd"
    holds = [(s.start_ns, s.end_ns) for s in spans(recording) if s.state == "hold"]
    published, versions = columns(recording, "/learner/published_version", timeline="run_time")
    assert versions.ravel().tolist() == list(range(1, len(published) + 1))
    for instant in published:
        assert not any(start < instant < (end or 2**62) for start, end in holds)
    times, acting = columns(recording, "/agent/policy_version", timeline="run_time")
    changes = times[1:][np.diff(np.nan_to_num(acting.ravel(), nan=0)) != 0]
    assert len(changes) == len(published)
    for change in changes:  # adoption time: the way to the agent and one tick
        nearest = published[published <= change].max()
        assert change - nearest < 400_000_000


def test_the_recording_has_every_tick(whole_run: Path) -> None:
    summary = summary_of(whole_run)
    ticks, reward = columns(whole_run / "recording.rrd", "/env/reward")
    assert len(ticks) == len(set(ticks.tolist())) == summary["ticks"]
    _, episode_returns = columns(whole_run / "recording.rrd", "/env/return")
    np.testing.assert_allclose(episode_returns.ravel(), summary["returns"], rtol=1e-5)
    assert np.isfinite(reward).all()


def test_the_recording_verifies(whole_run: Path) -> None:
    verify = [sys.executable, "-m", "rerun", "rrd", "verify", str(whole_run / "recording.rrd")]
    assert subprocess.run(verify, capture_output=True, timeout=30, check=False).returncode == 0


def test_an_operators_hold_stops_publishing_and_resume_goes_on(held_run: Path) -> None:
    recording = held_run / "recording.rrd"
    times, lines = texts(recording, "/log")
    (held,) = [t for t, line in zip(times, lines, strict=True) if "operator: hold" in line]
    (resumed,) = [t for t, line in zip(times, lines, strict=True) if "operator: resume" in line]
    published, _ = columns(recording, "/learner/published_version", timeline="run_time")
    assert not ((published > held) & (published < resumed)).any()
    assert (published < held).any() and (published > resumed).any()
    assert [s.state for s in spans(recording) if s.start_ns >= held] == ["hold", "update"]
    assert summary_of(held_run)["operator_holds"] == 1


def order(run: Path, verb: str) -> str:
    done = subprocess.run(
        tenuto(verb, "--run-dir", str(run)), capture_output=True, text=True, timeout=30, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_one_interrupt_ends_in_order_within_five_seconds_with_all_files_whole(interrupted_run: Path) -> None:
    summary = summary_of(interrupted_run)
    assert summary["ended"] == "interrupted" and summary["forced"] == []
    assert discrepancies(summary) == [] and summary["transitions"]["lost"] == 0
    assert len(columns(interrupted_run / "recording.rrd", "/env/reward")[0]) == summary["ticks"]


def test_two_interrupts_end_at_once(twice_interrupted_run: Path) -> None:
    assert twice_interrupted_run.is_dir()  # within 10 s, with exit code 130


@pytest.mark.parametrize("sequence", ["env_last", "env_first"])
def test_any_process_may_be_first_and_a_late_learner_is_picked_up(
    sequence: str, env_last: Path, env_first: Path
) -> None:
    run = env_last if sequence == "env_last" else env_first
    stats = {s.process: s for s in RunDir.open(run).read_final_stats()}
    assert stats["learner"].counters["learned"] == stats["env_server"].counters["produced"]
    assert stats["agent_service"].counters["policies.adopted"] >= 3
    assert len(columns(run / "recording.rrd", "/env/reward")[0]) == stats["env_server"].counters["ticks"]
