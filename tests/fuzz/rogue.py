"""A rogue beside the real services of a simulation, and the accounts of what became of what it sent."""

from __future__ import annotations

import random
from collections import Counter, defaultdict, deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from env_server.worlds.registry import resolve
from experiments.presets import pointmass
from launcher.sim import Simulation
from launcher.watch import Watch
from rtcore import channels
from rtcore.channels import Channel
from rtcore.codec import Codec
from rtcore.config import RunConfig, ScheduleConfig
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Stats
from rtcore.run_dir import RunDir
from tests.fuzz.mutations import Mutator

CLIENT = "client"


@cache
def channel_of(key: str) -> Channel[Any] | None:
    """The channel that a key is of."""
    for channel in channels.TABLE:
        parts, wanted = key.split("/"), channel.key.split("/")
        if len(parts) == len(wanted) and all(w in ("{name}", p) for p, w in zip(parts, wanted, strict=True)):
            return channel
    return None


class Rogue(bytes):
    """A payload that the rogue sent, to be told from a true one."""


class Accounts:
    """What became of each rogue payload: one entry for each reader that it was delivered to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.delivered: Counter[str] = Counter()
        self.accepted: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        decode, fits = Codec.decode, Codec.fits

        def counting_decode(codec: Codec[Any], payload: bytes, name: str = "") -> Any:
            message = decode(codec, payload, name)
            if isinstance(payload, Rogue):
                (self.refused if message is None else self.accepted)[codec._channel.name] += 1
            return message

        monkeypatch.setattr(Codec, "decode", counting_decode)
        self._fits = fits

    def sent(self, channel: Channel[Any], payload: bytes, readers: int) -> None:
        """A payload was delivered to so many readers."""
        self.delivered[channel.name] += readers
        if len(payload) > channel.max_bytes:
            self.refused[channel.name] += readers


@dataclass
class Outcome:
    """What a run came to, as far as nobody but the true processes may have a say in it."""

    policies: list[bytes]  # as they were published
    log: list[bytes]  # likewise
    final: dict[str, Stats]
    watch: Watch


class RogueRun:
    """A simulation of all services with a launcher's watch, and a rogue that speaks in every tick."""

    def __init__(self, path: Path, config: RunConfig, stack: ExitStack) -> None:
        self.run_dir = RunDir.create(path, config)
        self.config = config
        self.simulation = Simulation(config, self.run_dir, stack)
        self.env, self.agent = self.simulation.pairs[0]
        self.hub: MemoryHub = self.simulation._hub
        self.client = self.hub.bus(CLIENT, self.simulation._clock)
        stack.callback(self.client.close)
        self._stats = self.client.queue(channels.STATS, "*")
        self.watch = Watch(config.env.hz or 1.0)
        self.heard: dict[str, deque[bytes]] = defaultdict(lambda: deque(maxlen=32))
        self.policies: list[bytes] = []
        self.log: list[bytes] = []
        self._exchange = self.hub._exchange
        self._deliver = self._exchange.deliver
        self._exchange.deliver = self._overhear  # type: ignore[method-assign]
        for name in ("learner", "env_server", "agent_service"):
            self._serve(name)

    def run(self, speak: Callable[[int], None]) -> Outcome:
        """The whole run; `speak` is called in each tick, between the agent's answer and the deadline."""
        sim = self.simulation
        self.env.announce()
        self.agent.attend()
        for tick in self.env.pacer.ticks(Stop()):
            speak(tick.index)
            self.agent.poll_policies()
            self.env.step(tick)
            self.agent.check()
            flushed = self.env.journal.flush_due(sim._clock.now_ns())
            sim.learner.catch_up()
            if flushed:
                sim._record()
                self._look()
        self.env.close()
        sim.learner.catch_up()
        sim.learner.close()
        self.agent.poll_policies()
        self.agent.close()
        final = {name: stats[0] for name, stats in sim.finish().items()}
        self._look()
        return Outcome(self.policies, self.log, final, self.watch)

    def inject(self, key: str, payload: bytes, accounts: Accounts | None = None) -> None:
        """Send as the rogue."""
        self._deliver(key, Rogue(payload))
        channel = channel_of(key)
        if accounts is not None and channel is not None:
            accounts.sent(channel, payload, len(self._exchange._routes[key]))

    def ask(self, name: str, payload: bytes) -> bytes | None:
        """Send a command's bytes as the rogue."""
        server = self._exchange.server(name)
        assert server is not None
        return server.answer(payload)

    def rejected(self) -> Counter[str]:
        """By channel, over all processes."""
        total: Counter[str] = Counter(self.client.rejected())
        for bus in self.simulation._buses.values():
            total.update(bus.rejected())
        return total

    def _overhear(self, key: str, payload: bytes) -> None:
        self.heard[key].append(payload)
        if key == channels.POLICY.key:
            self.policies.append(payload)
        elif key.endswith("/log"):
            self.log.append(payload)
        self._deliver(key, payload)

    def _serve(self, name: str) -> None:
        sim = self.simulation
        handlers = {
            "learner": sim.learner.command,
            "agent_service": self.agent.command,
            "env_server": lambda command: self.env.command(command, Stop()),
        }
        sim._buses[name].serve(name, handlers[name])

    def _look(self) -> None:
        for received in self._stats.drain():
            self.watch.feed(received.message, received.received_ns)
        for process in channels.PROCESSES:
            self.watch.totals(process)
            self.watch.rate(process, "ticks")
            self.watch.health(process, self.simulation._clock.now_ns())
        self.watch.phase()


def small(duration_s: float) -> RunConfig:
    """Point mass with a tiny student: 50 ticks a second."""
    base = pointmass()
    env = resolve(replace(base.env, hz=50.0, speed=None, episode_steps=40, unit_s=1.0))
    learner = replace(
        base.learner, hidden=(8, 8), batch=8, learning_starts=50, utd=0.1,
        schedule=ScheduleConfig(l_f=4, gamma_f=0.5),
    )  # fmt: skip
    return replace(base, seed=5, duration_s=duration_s, env=env, learner=learner)


class Speaker:
    """Mutates what it overheard, on all keys in turn."""

    def __init__(self, run: RogueRun, accounts: Accounts, seed: int) -> None:
        self._run = run
        self._accounts = accounts
        self._rng = random.Random(seed)
        self._mutator = Mutator(self._rng)
        self.sent = 0

    def speak(self, n: int) -> None:
        """Send `n` messages, once something was heard."""
        heard = self._run.heard
        keys = [key for key in heard if channel_of(key) is not None]
        if not keys:
            return
        others = [payloads[-1] for payloads in heard.values()]
        spoken = [channel for channel in channels.TABLE if any(channel_of(key) is channel for key in keys)]
        for _ in range(n):
            channel = self._rng.choice(spoken)
            key = self._rng.choice([key for key in keys if channel_of(key) is channel])
            payload = self._mutator.mutate(heard[key], others, channel.max_bytes)
            self._run.inject(key, payload, self._accounts)
            self.sent += 1
