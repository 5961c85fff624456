"""A real run whose recorder's disk gets full, and has room again at the end: nobody else notices."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from recorder import reading
from rtcore import channels
from rtcore.config import AgentConfig, EnvConfig, RecorderConfig, RunConfig
from rtcore.run_dir import RunDir

HZ = 50
PATIENCE_S = 40.0
ROLES = (channels.ENV_SERVER, channels.AGENT, channels.RECORDER)


def until_it_says(run_dir: RunDir, process: subprocess.Popen[bytes], text: str) -> None:
    log, deadline = run_dir.log_path(channels.RECORDER), time.monotonic() + PATIENCE_S
    while text not in log.read_text():
        assert process.poll() is None, "the recorder has ended"
        assert time.monotonic() < deadline, f"never said: {text}"
        time.sleep(0.05)


def test_the_others_do_not_notice_that_the_recorders_disk_is_full(tmp_path: Path) -> None:
    env = EnvConfig(id="pointmass", hz=HZ, start_wait_s=2.0)
    config = RunConfig(
        preset="pointmass",
        duration_s=60.0,
        env=env,
        agent=AgentConfig(rt="off"),
        recorder=RecorderConfig(),
    )
    run_dir = RunDir.create(tmp_path / "r1", config)
    with ExitStack() as stack:
        processes = {
            role: stack.enter_context(
                subprocess.Popen([sys.executable, "-m", role, "--run", str(run_dir.path)])
            )
            for role in ROLES
        }
        for process in processes.values():
            stack.callback(process.kill)
        recorder, pid = processes[channels.RECORDER], processes[channels.RECORDER].pid
        deadline = time.monotonic() + PATIENCE_S
        while not run_dir.recording_path.exists() or run_dir.recording_path.stat().st_size < 150_000:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        full = run_dir.recording_path.stat().st_size + 1000  # a piece that begins here is torn
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
        until_it_says(run_dir, recorder, "the disk takes no rows: File too large")
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        for role in ROLES:  # the recorder makes a last attempt
            processes[role].send_signal(signal.SIGTERM)
            assert processes[role].wait(timeout=PATIENCE_S) == 0
    books = {stats.process: stats.counters for stats in run_dir.read_final_stats()}
    served, recorded = books[channels.ENV_SERVER], books[channels.RECORDER]
    assert served.get("log.dropped", 0) == served.get("log.errors", 0) == 0
    assert recorded["disk_dropped"] == recorded["dropped"] > 0
    ticks = reading.columns(run_dir.recording_path, "/env/reward")[0].tolist()
    lost = served["ticks"] - len(ticks)
    assert len(set(ticks)) == len(ticks)
    assert 0 < lost < recorded["dropped"]  # a step is several rows
    assert ticks[-1] >= served["ticks"] - 1  # the last one is there
