"""The recorder as a process: real bus, real clock, real signals."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from recorder import reading
from rtcore import channels
from rtcore.bus import NoAnswerError
from rtcore.config import RecorderConfig, RunConfig
from rtcore.messages import Command, StepBatch
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import ZenohBus, open_bus
from tests.recorder.stage import SPEC, make_step

PATIENCE_S = 25.0  # 2 s on an idle machine; the recorder is nice and gets little of a busy one


def test_it_records_until_sigterm_and_leaves_a_finished_file(tmp_path: Path) -> None:
    run_dir = RunDir.create(tmp_path / "r1", RunConfig(recorder=RecorderConfig()))
    clock = MonotonicClock()
    t0 = clock.now_ns()
    spec = msgspec.structs.replace(SPEC, t0_ns=t0, incarnation=1)
    steps = [make_step(seq, incarnation=1, due_ns=t0 + seq * 20_000_000) for seq in range(100)]
    with (
        open_bus(channels.ENV_SERVER, run_dir.run_name, run_dir.socket_dir(), clock=clock) as bus,
        running(run_dir) as process,
    ):
        bus.publisher(channels.SPEC, "env0").put(spec)
        log = bus.publisher(channels.LOG, "env0")
        log.put(StepBatch(steps=steps[:60]))
        wait_for_rows(bus)
        process.send_signal(signal.SIGTERM)
        log.put(StepBatch(steps=steps[60:], last=True))  # the env server ends after the recorder was told to
        assert process.wait(timeout=PATIENCE_S) == 0
    assert reading.columns(run_dir.recording_path, "/env/reward")[0].tolist() == list(range(100))
    (stats,) = run_dir.read_final_stats()
    assert stats.process == "recorder"
    assert stats.counters["dropped"] == 0
    assert stats.counters["rows"] > 600
    texts = reading.texts(run_dir.recording_path, "/log")[1]
    assert any(text.startswith("[recorder] ") for text in texts)  # where it runs


def test_killed_while_the_env_server_goes_on_it_comes_back_to_every_step_once(tmp_path: Path) -> None:
    run_dir = RunDir.create(tmp_path / "r1", RunConfig(recorder=RecorderConfig()))
    clock = MonotonicClock()
    t0 = clock.now_ns()
    steps = [make_step(seq, incarnation=1, due_ns=t0 + seq * 20_000_000) for seq in range(120)]
    with open_bus(channels.ENV_SERVER, run_dir.run_name, run_dir.socket_dir(), clock=clock) as bus:
        bus.publisher(channels.SPEC, "env0").put(msgspec.structs.replace(SPEC, t0_ns=t0, incarnation=1))
        log = bus.publisher(channels.LOG, "env0")
        log.put(StepBatch(steps=steps[:40]))
        with running(run_dir) as process:
            wait_for_rows(bus)
            log.put(StepBatch(steps=steps[40:60]))  # it may have taken them, written them, or neither
            process.kill()
            assert process.wait() == -signal.SIGKILL
        log.put(StepBatch(steps=steps[60:90]))  # while nobody records
        with running(run_dir) as process:
            wait_for_rows(bus)
            log.put(StepBatch(steps=steps[90:], last=True))
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=PATIENCE_S) == 0
    assert reading.columns(run_dir.recording_path, "/env/reward")[0].tolist() == list(range(120))
    assert [stats.counters["dropped"] for stats in run_dir.read_final_stats()] == [0, 0]


@contextmanager
def running(run_dir: RunDir) -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen([sys.executable, "-m", "recorder", "--run", str(run_dir.path)]) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for_rows(bus: ZenohBus) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        try:
            reply = bus.ask(channels.RECORDER, Command(id=str(time.monotonic_ns()), verb="status"))
        except NoAnswerError:
            continue
        if not reply.text.startswith("0 rows"):
            assert reply.ok
            return
        time.sleep(0.05)
    pytest.fail("nothing was written")
