"""The env server as a process that is killed: the next one goes on in the same run."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import msgspec

from env_server.worlds.registry import resolve
from rtcore import channels, epoch
from rtcore.bus import QueueReader
from rtcore.config import AgentConfig, DriftConfig, EnvConfig, RecorderConfig, RunConfig
from rtcore.messages import Spec, Step, StepBatch
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import open_bus

ROOT = Path(__file__).parents[2]
DRIFT = DriftConfig(kind="sine", amplitude=1.0, omega=0.7)
ENV = EnvConfig(id="pointmass", hz=100.0, episode_steps=9, unit_s=0.1, start_wait_s=0.0, drift=DRIFT)
CONFIG = RunConfig(
    duration_s=0.0, env=resolve(ENV), agent=AgentConfig(rt="off"), recorder=RecorderConfig(record=False)
)
TICK_NS = 10_000_000
SECOND = 1_000_000_000


def env_server(run: RunDir) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "env_server", "--run", str(run.path)], cwd=ROOT)


def read_on(log: QueueReader[StepBatch], steps: list[Step], lives: int, enough: int) -> None:
    """Until there are so many lives, and so many steps of the last of them."""
    begin = time.monotonic()
    while time.monotonic() < begin + 20:
        log.wait(0.1)
        steps += [step for received in log.drain() for step in received.message.steps]
        of_lives = Counter(step.incarnation for step in steps)
        if len(of_lives) == lives and of_lives[max(of_lives)] >= enough:
            return


def test_a_killed_env_server_is_followed_by_one_that_goes_on(tmp_path: Path) -> None:
    run, clock = RunDir.create(tmp_path / "run", CONFIG), MonotonicClock()
    steps: list[Step] = []
    with open_bus(channels.LEARNER, run.run_name, run.socket_dir(), clock=clock) as bus:
        log, specs = bus.queue(channels.LOG, "*"), bus.queue(channels.SPEC, "*")
        with env_server(run) as first:
            read_on(log, steps, 1, 30)
            first.send_signal(signal.SIGKILL)
        killed_ns = clock.now_ns()
        time.sleep(0.2)
        with env_server(run) as second:
            read_on(log, steps, 2, 30)
            second.send_signal(signal.SIGTERM)
            assert second.wait(20) == 0
        while log.wait(0.2):
            steps += [step for received in log.drain() for step in received.message.steps]
        declared = {spec.incarnation: spec for spec in (one.message for one in specs.drain())}
    run.remove_socket_dir()
    _check_run(run, steps, sorted(declared.values(), key=lambda spec: spec.incarnation), killed_ns)


def _check_run(run: RunDir, steps: list[Step], specs: list[Spec], killed_ns: int) -> None:
    first, second = (
        [step for step in steps if step.incarnation == spec.incarnation] for spec in (specs[0], specs[-1])
    )
    assert len(specs) == 2 and first and second
    assert (specs[0].t0_ns, specs[0].wall_t0_ns) == (specs[1].t0_ns, specs[1].wall_t0_ns)
    assert specs[0].host == specs[1].host == epoch.this_boot()
    t0_ns = specs[0].t0_ns
    assert second[0].due_ns > killed_ns + SECOND // 5
    for step in steps:
        assert step.due_ns == t0_ns + step.tick * TICK_NS
        assert step.unit == step.tick // 10
        assert math.isclose(step.drift, math.sin(0.7 * step.unit), abs_tol=1e-9)
    ticks = [step.tick for step in steps]
    assert ticks == sorted(set(ticks))
    assert second[0].episode > first[-1].episode
    killed, last = run.read_final_stats()
    assert (killed.final, last.final) == (False, True)
    assert killed.counters["ticks"] >= len(first)
    both = [killed.counters[name] + last.counters[name] for name in ("ticks", "skipped", "down", "lives")]
    # Every deadline to the last tick, and none that was not due when the last ledger was written.
    assert second[-1].tick + 1 <= sum(both[:3]) <= (last.at_ns - t0_ns) // TICK_NS + 1
    assert both[3] == 2
    assert last.counters["down"] > 20
    assert msgspec.json.decode(run.epoch_path.read_bytes())["lives"] == 2
