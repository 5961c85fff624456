"""What a health check makes of what a process says about itself."""

from __future__ import annotations

import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from launcher import health
from launcher.cli import run_command
from launcher.run_delay import RunDelay
from launcher.starting import process_command
from rtcore.channels import LEARNER, STATS
from rtcore.config import RunConfig
from rtcore.memory_bus import MemoryHub
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from tests.launcher.commands import tenuto
from tests.launcher.ledgers import CONFIG, FLEET, ledger

S = 1_000_000_000
STUCK_S = 0.3


def listened(beat_ago_s: float | None) -> float | None:
    """The verdict on a learner whose loop turned so long ago, and who says so all the time."""
    hub, clock, over = MemoryHub(), MonotonicClock(), threading.Event()
    bus, speaker = hub.bus("client", clock), hub.bus(LEARNER, clock)
    stats = speaker.publisher(STATS, LEARNER)
    beat_ns = 0 if beat_ago_s is None else clock.now_ns() - round(beat_ago_s * S)

    def speak() -> None:
        while not over.wait(0.02):
            stats.put(ledger(LEARNER, beat_ns=beat_ns))

    thread = threading.Thread(target=speak)
    thread.start()
    try:
        return health.turned(bus, LEARNER, clock, STUCK_S)
    finally:
        over.set()
        thread.join()


def test_a_loop_that_turned_lately_is_well() -> None:
    age_s = listened(0.1)
    assert age_s is not None
    assert 0.1 <= age_s <= STUCK_S


def test_one_that_has_not_is_not_though_its_threads_speak() -> None:
    assert listened(1.0) is None
    assert listened(None) is None  # it has only begun


def test_who_is_silent_is_not_well() -> None:
    hub, clock = MemoryHub(), MonotonicClock()
    assert health.turned(hub.bus("client", clock), LEARNER, clock, 0.1) is None


def test_only_a_process_that_had_the_time_to_turn_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "some_role.py").write_text("import time\nprint('up', flush=True)\ntime.sleep(60)\n")
    command = [sys.executable, "-m", "some_role", "--run", str(tmp_path)]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            assert not health.kill(tmp_path, "some_role")
            assert process.poll() is None
            monkeypatch.setattr(health, "START_NS", 0)
            assert health.kill(tmp_path, "some_role")
            assert process.wait(5) == -9
            assert not health.kill(tmp_path, "some_role")
        finally:
            process.kill()


@pytest.mark.parametrize(("waited_s", "killed"), [(0.4, True), (0.6, False)])
def test_who_waited_for_a_core_is_left_alone(
    waited_s: float,
    killed: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = RunDir.create(tmp_path / "r1", replace(CONFIG, supervise=replace(CONFIG.supervise, stuck_s=1.0)))
    monkeypatch.setattr(health, "START_NS", 0)
    monkeypatch.setattr(health, "waited_s", lambda delays, clock: waited_s * len(delays))
    (tmp_path / "learner.py").write_text("import time\nprint('up', flush=True)\ntime.sleep(60)\n")
    command = process_command(LEARNER, run.path)
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            assert run_command(["health", LEARNER, "--run-dir", str(run.path), "--kill-stuck"]) == 1
            assert (process.wait(5) if killed else process.poll()) == (-9 if killed else None)
        finally:
            process.kill()
    how = " and was killed" if killed else ", and waited for a core for 0.6 s"
    assert capsys.readouterr().err == f"tenuto: learner has not turned for 1 s{how}\n"


def test_how_long_it_waited_is_the_longest_of_its_lives() -> None:
    class Delay(RunDelay):
        def grown_ns(self, now_ns: int) -> int:
            return 2 * S if self._pid == 1 else S

    clock = MonotonicClock()
    assert health.waited_s([Delay(0), Delay(1)], clock) == 2.0
    assert health.waited_s([], clock) == 0.0


def test_wrong_input(tmp_path: Path) -> None:
    missing = tenuto("health", LEARNER, cwd=tmp_path)
    assert (missing.returncode, missing.stderr) == (2, "tenuto: run_dir = None: must be given\n")
    nobody = tenuto("health", "nobody", "--run-dir", "x", cwd=tmp_path)
    assert nobody.returncode == 2
    assert nobody.stderr.startswith("tenuto: process = 'nobody': one of env_server, agent_service")


@pytest.mark.parametrize(
    ("config", "asked", "allowed"),
    [
        (FLEET, "env_server", "env_server.0, env_server.1, env_server.2, agent_service.0"),
        (FLEET, "env_server.3", "env_server.0, env_server.1, env_server.2, agent_service.0"),
        (FLEET, "learner.0", "env_server.0, env_server.1"),
        (CONFIG, "env_server.0", "env_server, agent_service, learner, recorder"),
    ],
)
def test_a_process_is_one_of_the_runs_own(
    config: RunConfig, asked: str, allowed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = RunDir.create(tmp_path / "r1", config)
    assert run_command(["health", asked, "--run-dir", str(run.path)]) == 2
    assert capsys.readouterr().err.startswith(f"tenuto: process = '{asked}': one of {allowed}")


def test_only_the_process_of_that_name_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "START_NS", 0)
    (tmp_path / "some_role.py").write_text("import time\nprint('up', flush=True)\ntime.sleep(60)\n")
    commands = [process_command(f"some_role.{index}", tmp_path) for index in (0, 1)]
    found = [subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE) for command in commands]
    try:
        for process in found:
            assert process.stdout is not None
            process.stdout.readline()
        assert health.kill(tmp_path, "some_role.1")
        assert found[1].wait(5) == -9
        assert found[0].poll() is None
    finally:
        for process in found:
            process.kill()
            process.communicate()
