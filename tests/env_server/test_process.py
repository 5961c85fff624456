"""The env server as a process, over Zenoh."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from env_server.worlds.registry import resolve
from rtcore import channels
from rtcore.config import AgentConfig, EnvConfig, RunConfig
from rtcore.messages import Command, Stats, Step
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import open_bus

ROOT = Path(__file__).parents[2]
ENV = EnvConfig(id="pointmass", hz=100.0, episode_steps=9, unit_s=0.1, start_wait_s=0.0)
CONFIG = RunConfig(duration_s=0.5, env=resolve(ENV), agent=AgentConfig(rt="off"))


@contextmanager
def env_server(config: RunConfig, path: Path) -> Iterator[tuple[RunDir, subprocess.Popen[str]]]:
    run = RunDir.create(path, config)
    arguments = [sys.executable, "-m", "env_server", "--run", str(path)]
    with subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield run, process
        finally:
            process.kill()
            run.remove_socket_dir()


def ended(run: RunDir, process: subprocess.Popen[str]) -> Stats:
    _, stderr = process.communicate(timeout=20)
    assert process.returncode == 0, stderr
    (stats,) = run.read_final_stats()
    return stats


def test_a_run_with_nobody_else_there_ends_by_itself(tmp_path: Path) -> None:
    with env_server(CONFIG, tmp_path / "run") as (run, process):
        stats = ended(run, process)
    counters = stats.counters
    assert stats.final and stats.process == channels.ENV_SERVER
    assert counters["ticks"] + counters["skipped"] == 50
    assert counters["ticks"] == counters["produced"] + counters["resets"]
    assert counters["missed"] == counters["missed.agent_absent"] == counters["produced"]
    assert not run.world_path.exists()


def test_every_step_reaches_a_reader_of_the_log_and_a_command_stops_it(tmp_path: Path) -> None:
    config = replace(CONFIG, duration_s=0.0)
    clock = MonotonicClock()
    with (
        env_server(config, tmp_path / "run") as (run, process),
        open_bus("client", run.run_name, run.socket_dir(), clock=clock) as bus,
    ):
        log = bus.queue(channels.LOG, "*")
        steps: list[Step] = []
        last, asked, begin = False, False, time.monotonic()
        while not last and time.monotonic() < begin + 20:
            log.wait(0.1)
            for received in log.drain():
                steps += received.message.steps
                last = last or received.message.last
            if len(steps) > 40 and not asked:
                asked = bus.ask(channels.ENV_SERVER, Command(id="1", verb="stop")).ok
        stats = ended(run, process)
    assert last and asked
    assert {step.seq for step in steps} == set(range(stats.counters["ticks"]))
    assert all(step.woke_ns >= step.due_ns for step in steps)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_in_order(tmp_path: Path, number: signal.Signals) -> None:
    config = replace(CONFIG, duration_s=0.0, env=resolve(replace(ENV, start_wait_s=1000.0)))
    with env_server(config, tmp_path / "run") as (run, process):
        with open_bus("client", run.run_name, run.socket_dir(), clock=MonotonicClock()) as bus:
            begin = time.monotonic()
            while channels.ENV_SERVER not in bus.alive():
                assert time.monotonic() < begin + 20
                time.sleep(0.01)
        begin = time.monotonic()
        process.send_signal(number)
        stats = ended(run, process)
        assert time.monotonic() < begin + 5
    assert stats.final and stats.counters["ticks"] == 0


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (replace(CONFIG, env=EnvConfig(id="CartPole-v1")), "env.id = 'CartPole-v1': needs a continuous"),
        (replace(CONFIG, env=EnvConfig(hz=200.0, speed=3.0)), "env.speed = 3.0: at env.hz = 200"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(tmp_path: Path, config: RunConfig, message: str) -> None:
    with env_server(config, tmp_path / "run") as (_, process):
        _, stderr = process.communicate(timeout=20)
    assert process.returncode == 2
    assert [line for line in stderr.splitlines() if line.startswith(f"env_server: {message}")]


def test_no_run_directory_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    arguments = [sys.executable, "-m", "env_server", "--run", str(tmp_path / "none")]
    done = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("env_server: run_dir = ")
    assert len(done.stderr.splitlines()) == 1
