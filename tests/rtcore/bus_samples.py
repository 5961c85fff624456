"""One valid message per channel, and how a test brings two buses together."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import msgspec

from rtcore import channels
from rtcore.bus import Bus, QueueReader
from rtcore.channels import Channel
from rtcore.histogram import Histogram
from rtcore.memory_bus import MemoryHub
from rtcore.messages import (
    Action,
    Architecture,
    EpisodeReturn,
    Event,
    Message,
    Policy,
    Spec,
    Stats,
    Step,
    StepBatch,
    WindowNotice,
)
from rtcore.monotonic import MonotonicClock
from rtcore.zenoh_bus import ZenohBus, open_bus
from rtcore.zenoh_config import CLIENT, session_config
from rtcore.zenoh_session import open_session

ENV = "env0"
PATIENCE_S = 10.0  # a test that waits longer has failed


class World(Protocol):
    """What a bus test needs of an implementation."""

    def bus(self, role: str) -> Bus:
        """Open a role's bus."""

    def inject(self, key: str, payload: bytes) -> None:
        """Send raw bytes on a key, to whoever listens by now."""


class MemoryWorld:
    """Buses of one in-memory hub, on the real clock, so that waits wait."""

    def __init__(self) -> None:
        self._hub = MemoryHub()

    def bus(self, role: str) -> Bus:
        return self._hub.bus(role, MonotonicClock())

    def inject(self, key: str, payload: bytes) -> None:
        self._hub.inject(key, payload)


class ZenohWorld:
    """Real sessions over unix sockets in a short directory."""

    RUN = "test run/1"  # to be quoted in keys

    def __init__(self, socket_dir: Path) -> None:
        self.socket_dir = socket_dir
        self._opened: list[ZenohBus] = []
        self._intruders: list[Any] = []

    def bus(self, role: str) -> ZenohBus:
        bus = open_bus(role, self.RUN, self.socket_dir, clock=MonotonicClock())
        self._opened.append(bus)
        return bus

    def inject(self, key: str, payload: bytes) -> None:
        import zenoh

        settings: Any = session_config(CLIENT, self.RUN, self.socket_dir)
        connect = settings["connect"]  # opening waits for those who are not there
        connect["endpoints"] = [one for one in connect["endpoints"] if Path(one.partition("/")[2]).exists()]
        session = open_session(settings)
        self._intruders.append(session)
        publisher: Any = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        assert eventually(lambda: publisher.matching_status.matching)
        publisher.put(payload)

    def close(self) -> None:
        for bus in (*self._intruders, *self._opened):
            bus.close()


def eventually(predicate: Callable[[], bool], patience_s: float = PATIENCE_S) -> bool:
    """Whether the predicate comes true in time."""
    deadline = time.monotonic() + patience_s
    while not predicate():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


def meet(bus: Bus, channel: Channel[Step], reader: QueueReader[Step]) -> None:
    """Put on a channel without history until its reader hears it; the reader is empty afterwards."""
    probe = bus.publisher(channel, ENV)
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        probe.put(step(0))
        if reader.wait(0.2):
            reader.drain()
            return
    raise AssertionError("the buses never met")


def collect(reader: QueueReader[StepBatch], until: int, patience_s: float = PATIENCE_S) -> list[int]:
    """The sequence numbers that come, until `until` was among them."""
    numbers: list[int] = []
    deadline = time.monotonic() + patience_s
    while until not in numbers and time.monotonic() < deadline:
        reader.wait(0.05)
        numbers += [s.seq for received in reader.drain() for s in received.message.steps]
    return numbers


def step(seq: int, incarnation: int = 1, observation: bytes = b"\0" * 68) -> Step:
    return Step(
        env=ENV,
        incarnation=incarnation,
        seq=seq,
        tick=seq + 3,
        episode=1,
        episode_tick=seq,
        unit=2,
        due_ns=10,
        woke_ns=11,
        sent_ns=12,
        observation=observation,
        reward=-0.25,
        terminated=False,
        truncated=True,
        action=b"\1" * 24,
        decision=b"\2" * 24,
        answered_tick=-1,
        policy_version=7,
        missed=True,
        fallback="hold",
        cause="agent_late",
        skipped=1,
        loop_ns=-1,
        reaction_ns=5,
        drift=1.5,
        position=b"\3" * 72,
    )


def batch(seq: int, incarnation: int = 1, env: str = ENV) -> StepBatch:
    return StepBatch(steps=[msgspec.structs.replace(step(seq, incarnation), env=env)])


def policy(version: int, weights: bytes = b"weights") -> Policy:
    architecture = Architecture(kind="tanh_gaussian_mlp", observation_dim=17, action_dim=6, hidden=[256, 256])
    return Policy(
        version=version,
        window=1,
        iterate=2,
        algo="fsac",
        architecture=architecture,
        weights=weights,
        sha256="00",
        created_ns=3,
    )


def stats(process: str, seq: int = 0) -> Stats:
    return Stats(
        process=process,
        incarnation=1,
        seq=seq,
        at_ns=2,
        final=False,
        counters={"ticks": 3},
        gauges={"alpha": 0.5},
        histograms={"loop": Histogram().to_bytes()},
        events=[Event(at_ns=1, level="WARN", text="late")],
        returns=[EpisodeReturn(episode=1, at_ns=2, value=3.5, length=4)],
    )


def window() -> WindowNotice:
    return WindowNotice(window=1, start_unit=10, update_units=7, hold_units=3, phase="hold", at_ns=4)


def spec() -> Spec:
    return Spec(
        env=ENV,
        env_id="pointmass",
        incarnation=1,
        t0_ns=5,
        wall_t0_ns=6,
        tick_ns=50_000_000,
        unit_ns=1_000_000_000,
        observation_dim=2,
        action_dim=1,
        action_low=[-1.0],
        action_high=[1.0],
    )


def action(tick: int = 3, values: bytes = b"\0" * 24) -> Action:
    return Action(
        env=ENV, incarnation=1, tick=tick, values=values, policy_version=0, received_ns=8, sent_ns=9
    )


SAMPLES: dict[str, tuple[str, Message]] = {  # per channel: name in the key, message
    channels.SPEC.name: (ENV, spec()),
    channels.STEP.name: (ENV, step(0)),
    channels.LOG.name: (ENV, batch(0)),
    channels.ACTION.name: (ENV, action()),
    channels.POLICY.name: ("", policy(1)),
    channels.WINDOW.name: ("", window()),
    channels.STATS.name: (channels.AGENT, stats(channels.AGENT)),
}
