"""Messages that must all be refused: by the codec, or by a service that knows what came before."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from rtcore import channels
from rtcore.channels import Channel
from rtcore.codec import CRC_BYTES, Codec, Rejections, name_in, seal
from rtcore.messages import Action, Policy, Spec, Stats, Step, StepBatch, WindowNotice
from tests.fuzz.mutations import Mutator
from tests.fuzz.rogue import RogueRun, channel_of

PER_TICK = 24
FUTURE = (10**6, 10**9, 1 << 39)  # ticks ahead


class Hostile:
    """Speaks in each tick of a run, of every channel."""

    def __init__(self, run: RogueRun, seed: int) -> None:
        self._run = run
        self._rng = random.Random(seed)
        self._mutator = Mutator(self._rng)
        self._codecs: dict[str, Codec[Any]] = {}
        self.sent = 0
        name = run.config.env.name
        self._keys = {channel.name: channel.key_for(name) for channel in channels.TABLE}
        self._forgeries: tuple[Callable[[], tuple[str, object] | None], ...] = (
            self._step, self._action, self._batch, self._spec, self._policy, self._stats, self._notice,
        )  # fmt: skip

    def speak(self, tick: int) -> None:
        """Some forgeries, and some noise on every channel."""
        if tick < 100:  # until everybody has said something
            return
        for forge in self._forgeries:
            forged = forge()
            if forged is not None:
                self._send(forged[0], seal(msgspec.msgpack.encode(forged[1])))
        heard = self._run.heard
        others = [payloads[-1] for payloads in heard.values()]
        for key in list(heard):
            channel = channel_of(key)
            for _ in range(PER_TICK // len(heard) if channel is not None else 0):
                assert channel is not None
                payload = self._mutator.mutate(heard[key], others, channel.max_bytes)
                if len(payload) > channel.max_bytes or self._codec(key, channel).decode(payload) is None:
                    self._send(key, payload)

    def _send(self, key: str, payload: bytes) -> None:
        self._run.inject(key, payload)
        self.sent += 1

    def _codec(self, key: str, channel: Channel[Any]) -> Codec[Any]:
        if key not in self._codecs:
            self._codecs[key] = Codec(channel, Rejections(lambda: 0), name_in(key))
        return self._codecs[key]

    def _newest(self, channel: Channel[Any], at: int = -1) -> Any:
        payload = self._run.heard[self._keys[channel.name]][at]
        return msgspec.msgpack.decode(payload[:-CRC_BYTES], type=channel.type)

    def _step(self) -> tuple[str, object]:
        step: Step = self._newest(channels.STEP)
        older: Step = self._newest(channels.STEP, self._rng.randrange(-20, -1))
        nan = np.full(len(step.observation) // 4, np.nan, "<f4").tobytes()
        later = self._rng.choice(FUTURE)
        forged = self._rng.choice((
            step, older,
            replace(step, tick=step.tick + 1, observation=nan),
            replace(step, tick=step.tick + 1, observation=step.observation + bytes(4)),
            replace(step, tick=step.tick + later, seq=step.seq + later),
            replace(step, tick=step.tick + 1, sent_ns=step.sent_ns + 10**12),
            replace(step, incarnation=step.incarnation + 1, tick=step.tick + 1),
            replace(step, incarnation=1 << 61),
            replace(step, rehearsal=True, tick=step.tick - 1),
        ))  # fmt: skip
        return self._keys["step"], forged

    def _action(self) -> tuple[str, object]:
        action: Action = self._newest(channels.ACTION)
        nan = np.full(len(action.values) // 4, np.nan, "<f4").tobytes()
        forged = self._rng.choice((
            replace(action, values=nan),
            replace(action, values=action.values + bytes(4)),
            replace(action, values=b""),
            replace(action, tick=action.tick - 1),
            replace(action, tick=action.tick + 10**15),
            replace(action, incarnation=action.incarnation + 1),
            self._newest(channels.ACTION, self._rng.randrange(-20, -1)),
        ))  # fmt: skip
        return self._keys["action"], forged

    def _batch(self) -> tuple[str, object]:
        batch: StepBatch = self._newest(channels.LOG)
        last = batch.steps[-1]
        later = self._rng.choice(FUTURE)
        forged = self._rng.choice((
            [replace(last, incarnation=last.incarnation + 1)],
            [replace(last, incarnation=1 << 61, seq=0)],
            [replace(last, tick=last.tick + later, seq=last.seq + later)],
            [replace(last, seq=last.tick + 1)],
            [replace(last, reward=float("nan"), seq=last.seq + 1)],
            [replace(last, decision=b"\xff" * 8, seq=last.seq + 1)],
            [last, replace(last, seq=last.seq - 1)],
            batch.steps,
        ))  # fmt: skip
        return self._keys["log"], StepBatch(steps=forged)

    def _spec(self) -> tuple[str, object]:
        spec: Spec = self._newest(channels.SPEC)
        newer = spec.incarnation + self._rng.randrange(1, 10**6)
        forged = self._rng.choice((
            replace(spec, incarnation=newer, observation_dim=spec.observation_dim + 1),
            replace(spec, incarnation=newer, action_low=[bound - 1 for bound in spec.action_low]),
            replace(spec, incarnation=newer, tick_ns=1),
            replace(spec, incarnation=newer, states=4, actions=2),
            replace(spec, observation_dim=1 << 60),
            replace(spec, action_low=[float("nan")] * spec.action_dim),
            replace(spec, action_high=[]),
            spec,
        ))  # fmt: skip
        return self._keys["spec"], forged

    def _policy(self) -> tuple[str, object] | None:
        if not self._run.heard.get(self._keys["policy"]):
            return None
        policy: Policy = self._newest(channels.POLICY)
        newer = policy.version + 1
        forged = self._rng.choice((
            replace(policy, version=newer, weights=policy.weights[:-1] + b"\x7f"),
            replace(policy, version=newer, sha256="0" * 64),
            replace(policy, version=max(1, policy.version - 1)),
            replace(policy, version=newer, architecture=replace(policy.architecture, hidden=[8, 8, 8])),
            replace(policy, version=newer, architecture=replace(policy.architecture, hidden=[1 << 40])),
            replace(policy, version=1 << 62),
            policy,
        ))  # fmt: skip
        return self._keys["policy"], forged

    def _stats(self) -> tuple[str, object]:
        key = f"stats/{channels.LEARNER}"
        stats: Stats = msgspec.msgpack.decode(self._run.heard[key][-1][:-CRC_BYTES], type=Stats)
        forged = self._rng.choice((
            replace(stats, process=channels.ENV_SERVER),
            replace(stats, process="nobody"),
            replace(stats, counters={str(number): 1 for number in range(1000)}),
            replace(stats, counters={"learned": -1}),
            replace(stats, histograms={"step": b"\x90"}),
        ))  # fmt: skip
        return key, forged

    def _notice(self) -> tuple[str, object]:
        notice: WindowNotice = self._newest(channels.WINDOW)
        forged = self._rng.choice((
            replace(notice, at_ns=1 << 63),
            replace(notice, start_unit=1 << 61),
        ))  # fmt: skip
        return self._keys["window"], forged
