"""The service under test in virtual time, with a scripted agent and a reader of its log."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from env_server.announcing import Past
from env_server.service import EnvService
from env_server.worlds.world import World
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.config import EnvConfig, RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import CAUSES, Step
from tests.env_server.scripted import ScriptedAgent, ScriptedWorld

START_NS = 1_000_000_000
TICK_NS = 10_000_000  # 100 Hz
MISSES = tuple(f"missed.{cause}" for cause in CAUSES)


def run_config(*, duration_s: float = 1.0, seed: int = 0, **env: object) -> RunConfig:
    fields: dict[str, object] = {
        "id": "pointmass",
        "hz": 100.0,
        "speed": 5.0,
        "episode_steps": 9,
        "unit_s": 0.1,
    }
    return RunConfig(seed=seed, duration_s=duration_s, env=msgspec.convert({**fields, **env}, EnvConfig))


class Rig:
    """A service, a scripted agent and a reader of the log, on one virtual clock."""

    def __init__(self, config: RunConfig, world: World | None = None) -> None:
        self.clock = VirtualClock(START_NS)
        self.hub = MemoryHub()
        self.ledger = Ledger("env_server", 1)
        self.world = world or ScriptedWorld()
        self.bus = self.hub.bus("env", self.clock)
        self.resumed_ns: list[int] = []  # when the env server was continued after a stop
        self.service = EnvService(
            config, self.world, self.bus, self.clock, self.ledger, 77,
            past=Past(wall_ns=lambda: 5_000_000_000),
            resumed_ns=lambda: self.resumed_ns,
        )  # fmt: skip
        self.agent = ScriptedAgent(self.hub.bus("agent", self.clock), self.clock)
        self.reader = self.hub.bus("reader", self.clock)
        self.log = self.reader.queue(channels.LOG, "*")
        self.log_copy = self.reader.queue(channels.LOG, "*")  # for a look while it runs

    def run(
        self, answer: Callable[[ScriptedAgent, Step], None] = ScriptedAgent.answer, stop: Stop | None = None
    ) -> list[Step]:
        """Run to the end, with `answer` after each step; the steps of the log."""
        self.service.announce()
        for tick in self.service.pacer.ticks(stop or Stop()):
            self.service.step(tick)
            answer(self.agent, self.agent.newest())
            self.service.journal.flush_due(self.clock.now_ns())
        self.service.close()
        batches = [received.message for received in self.log.drain()]
        assert [batch.last for batch in batches] == [False] * (len(batches) - 1) + [True]
        return [step for batch in batches for step in batch.steps]

    def causes(self) -> dict[str, int]:
        """The misses by cause, without the zeros; they add up to `missed`."""
        found = {cause: self.ledger.counter(f"missed.{cause}") for cause in CAUSES}
        assert sum(found.values()) == self.ledger.counter("missed")
        return {cause: count for cause, count in found.items() if count}

    def counts(self, *names: str) -> list[int]:
        return [self.ledger.counter(name) for name in names]


def silent(_agent: ScriptedAgent, _step: Step) -> None:
    """An agent that is not there."""
