"""A recorder with everything around it played by the test: bus in memory, virtual clock, synthetic steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from recorder.service import RecorderService
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.config import DriftConfig, EnvConfig, RecorderConfig, RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Architecture, Event, Policy, Spec, Stats, Step, StepBatch, WindowNotice
from rtcore.run_dir import RunDir

T0 = 7_000_000_123  # an odd number: a rounded stamp would show
WALL_T0 = 1_700_000_000_000_000_017
TICK = 20_000_000  # 50 Hz
UNIT = 1_000_000_000
MS = 1_000_000

CONFIG = RunConfig(
    preset="pointmass",
    seed=3,
    env=EnvConfig(id="pointmass", hz=50, drift=DriftConfig(kind="constant", offset=1.5)),
)
SPEC = Spec(
    env="env0",
    env_id="pointmass",
    incarnation=11,
    t0_ns=T0,
    wall_t0_ns=WALL_T0,
    tick_ns=TICK,
    unit_ns=UNIT,
    observation_dim=1,
    action_dim=1,
    action_low=[-1.0],
    action_high=[1.0],
    native_period_ns=50 * MS,
    scene="point",
)


def make_step(seq: int, **changes: Any) -> Step:
    """Step `seq` of an undisturbed run of 10-tick episodes; tick = seq unless changed."""
    tick = int(changes.pop("tick", seq))
    due = T0 + tick * TICK
    values: dict[str, Any] = {
        "env": "env0",
        "incarnation": 11,
        "seq": seq,
        "tick": tick,
        "episode": seq // 10,
        "episode_tick": seq % 10,
        "unit": tick * TICK // UNIT,
        "due_ns": due,
        "woke_ns": due + 1500,
        "sent_ns": due + 90_000,
        "observation": np.array([0.5], "<f4").tobytes(),
        "reward": 0.0 if seq % 10 == 0 else -0.25 * (seq % 10),
        "terminated": False,
        "truncated": seq % 10 == 9,
        "action": b"" if seq % 10 == 0 else np.array([0.1], "<f4").tobytes(),
        "decision": b"" if seq % 10 == 0 else np.array([0.1], "<f4").tobytes(),
        "answered_tick": -1 if seq % 10 == 0 else tick - 1,
        "policy_version": -1 if seq % 10 == 0 else seq // 10,
        "missed": False,
        "fallback": "",
        "cause": "",
        "skipped": 0,
        "loop_ns": 250_000 + seq,
        "reaction_ns": 80_000 + seq,
        "drift": 1.5,
        "position": np.array([0.1 * (seq % 10)], "<f8").tobytes(),
    }
    return Step(**{**values, **changes})


def make_policy(version: int, created_ns: int) -> Policy:
    architecture = Architecture(kind="tanh_gaussian_mlp", observation_dim=1, action_dim=1, hidden=[4])
    return Policy(
        version=version,
        window=0,
        iterate=version,
        algo="fsac",
        architecture=architecture,
        weights=b"",
        sha256="",
        created_ns=created_ns,
    )


def make_notice(window: int, phase: Any, at_ns: int, reason: Any = "schedule") -> WindowNotice:
    return WindowNotice(
        window=window,
        start_unit=3 * window,
        update_units=2,
        hold_units=1,
        phase=phase,
        at_ns=at_ns,
        reason=reason,
    )


def make_stats(process: str, seq: int, at_ns: int, **changes: Any) -> Stats:
    values: dict[str, Any] = {
        "process": process,
        "incarnation": 5,
        "seq": seq,
        "at_ns": at_ns,
        "final": False,
        "counters": {},
        "gauges": {},
        "histograms": {},
    }
    return Stats(**{**values, **changes})


@dataclass
class Stage:
    """The recorder under test, and the others' ends of the bus."""

    run_dir: RunDir
    config: RunConfig
    clock: VirtualClock
    ledger: Ledger
    service: RecorderService
    hub: MemoryHub

    def __post_init__(self) -> None:
        bus = self.hub.bus("others", self.clock)
        self.bus = bus
        self.spec = bus.publisher(channels.SPEC, "env0")
        self.log = bus.publisher(channels.LOG, "env0")
        self.policy = bus.publisher(channels.POLICY)
        self.window = bus.publisher(channels.WINDOW)

    @property
    def path(self) -> Path:
        return self.run_dir.recording_path

    def stats(self, stats: Stats) -> None:
        self.bus.publisher(channels.STATS, stats.process).put(stats)

    def steps(self, steps: Sequence[Step], *, size: int = 7, last: bool = False) -> None:
        """Send in batches of `size`, polling after each, at the time of its last step."""
        for i in range(0, len(steps), size):
            batch = list(steps[i : i + size])
            self.clock.sleep_until_ns(batch[-1].due_ns + MS)
            self.log.put(StepBatch(steps=batch, last=last and i + size >= len(steps)))
            self.service.poll()

    def events(self) -> list[Event]:
        """What the recorder said since the last call."""
        return self.ledger.stats(self.clock.now_ns()).events


def set_stage(tmp_path: Path, *, config: RunConfig = CONFIG, **recorder: Any) -> Stage:
    config = replace(config, recorder=RecorderConfig(**recorder))
    path = tmp_path / "runs" / "r1"
    run_dir = RunDir.open(path) if path.exists() else RunDir.create(path, config)
    clock, hub = VirtualClock(T0 - 2 * UNIT), MemoryHub()
    ledger = Ledger(channels.RECORDER, clock.now_ns())
    bus = hub.bus(channels.RECORDER, clock)
    service = RecorderService(config, run_dir, bus, clock, ledger)
    return Stage(run_dir, config, clock, ledger, service, hub)


def come_back(stage: Stage) -> Stage:
    """The next life of the stage's recorder, which has been killed."""
    clock, hub = stage.clock, stage.hub
    ledger = Ledger(channels.RECORDER, clock.now_ns())
    bus = hub.bus(channels.RECORDER, clock)
    service = RecorderService(stage.config, stage.run_dir, bus, clock, ledger)
    return Stage(stage.run_dir, stage.config, clock, ledger, service, hub)


def run(stage: Stage, steps: list[Step]) -> None:
    """A whole run: the declaration, `steps`, and the end."""
    stage.spec.put(SPEC)
    stage.steps(steps, last=True)
    stage.service.close()


def drain(stage: Stage) -> int:
    """Stop the recorder; how many ns it waits for the others' last words."""
    stop = Stop()
    stop.set("test")
    begin_ns = stage.clock.now_ns()
    stage.service.run(stop)
    return stage.clock.now_ns() - begin_ns
