"""A rogue on a real bus: a loop at 200 Hz goes on beside thousands of bad messages, and all are counted."""

from __future__ import annotations

import random
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from rtcore import channels
from rtcore.bus import QueueReader, Received
from rtcore.channels import AGENT, ENV_SERVER, RECORDER, TABLE, Channel
from rtcore.codec import seal
from rtcore.messages import Step
from tests.fuzz.mutations import Mutator
from tests.rtcore.bus_samples import ENV, SAMPLES, ZenohWorld, action, eventually, step

PERIOD_S = 0.005
TICKS = 400
PER_TICK = 10  # 2000 a second, 4000 in all


@pytest.fixture
def world() -> Iterator[ZenohWorld]:
    with tempfile.TemporaryDirectory(prefix="tn", dir="/tmp") as directory:
        opened = ZenohWorld(Path(directory))
        yield opened
        opened.close()


class Loop:
    """An env server's half of a loop: a step every period, and when the agent's answer was there."""

    def __init__(self, world: ZenohWorld) -> None:
        self._env, self.agent, self._others = world.bus(ENV_SERVER), world.bus(AGENT), world.bus(RECORDER)
        self.steps, self.actions = (
            self._env.publisher(channels.STEP, ENV),
            self._env.queue(channels.ACTION, ENV),
        )
        self._answers = self.agent.publisher(channels.ACTION, ENV)
        self.seen: Counter[str] = Counter()
        self.agent.attend(channels.STEP, ENV, self._answer)
        self._readers: list[tuple[Channel[Any], QueueReader[Any]]] = [
            (channel, self._others.queue(channel, "*" if "{name}" in channel.key else "", capacity=100_000))
            for channel in TABLE
            if channel not in (channels.STEP, channels.ACTION)
        ]

    def run(self, first: int) -> list[float]:
        """So many ticks from `first` on: seconds from step to answer; the period if it was late."""
        took: list[float] = []
        due = time.monotonic() + PERIOD_S
        for tick in range(first, first + TICKS):
            begin = time.monotonic()
            self.steps.put(step(tick))
            while time.monotonic() < due and not self._answered(tick + 3):  # as in the sample
                self.actions.wait(max(0.0, due - time.monotonic()) + 1e-4)
            took.append(time.monotonic() - begin)
            time.sleep(max(0.0, due - time.monotonic()))
            due = max(due + PERIOD_S, time.monotonic())
        return took

    def counted(self) -> Counter[str]:
        """Per channel: what was accepted or rejected so far."""
        for received in self.actions.drain():
            self.seen["action"] += bool(received)
        for channel, reader in self._readers:
            self.seen[channel.name] += len(reader.drain())
        total = Counter(self.seen)
        for bus in (self._env, self.agent, self._others):
            total.update(bus.rejected())
        return total

    def rejected(self) -> int:
        return sum(sum(bus.rejected().values()) for bus in (self._env, self.agent, self._others))

    def _answer(self, received: Received[Step]) -> None:
        self.seen["step"] += 1
        self._answers.put(action(tick=received.message.tick))

    def _answered(self, tick: int) -> bool:
        drained = self.actions.drain()
        self.seen["action"] += len(drained)
        return any(received.message.tick == tick for received in drained)


def prepare(rng: random.Random, n: int) -> list[tuple[str, str, bytes]]:
    """(channel, key, payload) of `n` bad messages: made before, since the loop shares the interpreter."""
    mutator = Mutator(rng)
    true = {name: seal(msgspec.msgpack.encode(message)) for name, (_, message) in SAMPLES.items()}
    found = []
    for _ in range(n):
        channel = rng.choice(TABLE)
        payload = mutator.mutate([true[channel.name]], list(true.values()), channel.max_bytes)
        found.append((channel.name, channel.key_for(SAMPLES[channel.name][0]), payload))
    return found


def test_a_loop_at_200_hz_goes_on_beside_thousands_of_bad_messages(world: ZenohWorld) -> None:
    loop = Loop(world)
    bad = prepare(random.Random(4), TICKS * PER_TICK)
    intruder = world.bus("client")._session
    publishers: dict[str, Any] = {
        key: intruder.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        for key in {key for _, key, _ in bad}
    }
    assert eventually(lambda: all(one.matching_status.matching for one in publishers.values()))
    assert eventually(lambda: loop.run(0)[-1] < PERIOD_S)
    quiet = loop.run(1000)
    before = loop.counted()

    def speak() -> None:
        for at in range(0, len(bad), PER_TICK):
            for _, key, payload in bad[at : at + PER_TICK]:
                publishers[key].put(payload)
            time.sleep(PERIOD_S)

    rogue = threading.Thread(target=speak)
    rogue.start()
    noisy = loop.run(2000)
    rogue.join()
    sent = Counter(name for name, _, _ in bad)
    answered = Counter({"step": TICKS, "action": TICKS})  # and a step that was accepted got its answer
    for name, n in sent.items():
        assert eventually(partial(arrived, loop, name, before[name] + n)), name
    counted = loop.counted()
    for name in sent.keys() - answered.keys():
        assert counted[name] - before[name] == sent[name]
    assert loop.rejected() > len(bad) / 2
    # No stall: whatever else goes on on this machine, the loop beside the rogue is like the one without.
    late = [sum(one >= PERIOD_S for one in took) for took in (quiet, noisy)]
    assert late[1] <= late[0] + TICKS / 4
    assert sorted(noisy)[TICKS // 2] < 10 * sorted(quiet)[TICKS // 2]


def arrived(loop: Loop, channel: str, n: int) -> bool:
    return loop.counted()[channel] >= n
