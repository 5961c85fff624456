"""A learner of several environments on a virtual clock, fed by hand over the in-memory bus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec

from learner.power import Levers
from learner.replay import Replay, open_replay
from rtcore import channels
from rtcore.cast import offset_ns as offset_of
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.messages import Spec, Step, StepBatch
from rtcore.run_dir import RunDir
from tests.learner.service_rig import CONFIG, SPEC, TICK_NS, Rig, step

ENVS = ("env0", "env1", "env2")
FLEET = replace(CONFIG, env=replace(CONFIG.env, count=3))
SECOND = 10  # ticks


def tick(seq: int, env: str, *, incarnation: int = 7, begin: int = 0, late: bool = False) -> Step:
    """The first of each incarnation, which begins at tick `begin`, is a reset. The reward is env's number."""
    return msgspec.structs.replace(
        step(seq, reset=seq == 0, late=late), env=env, incarnation=incarnation, tick=begin + seq,
        unit=(begin + seq) // SECOND, reward=float(ENVS.index(env)), due_ns=(begin + seq) * TICK_NS,
        woke_ns=(begin + seq) * TICK_NS, sent_ns=(begin + seq) * TICK_NS,
    )  # fmt: skip


class Fleet(Rig):
    """A learner and three env servers."""

    def __init__(
        self,
        run_dir: RunDir,
        config: RunConfig = FLEET,
        *,
        at: int = 0,
        declare: Sequence[str] = ENVS,
        levers: Levers | None = None,
        clock: VirtualClock | None = None,
    ) -> None:
        super().__init__(run_dir, config, levers=levers, clock=clock)
        self.clock.sleep_until_ns(at * TICK_NS)
        server = self.hub.bus(channels.ENV_SERVER, self.clock)
        self.declare = {env: server.publisher(channels.SPEC, env) for env in ENVS}
        self.logs = {env: server.publisher(channels.LOG, env) for env in ENVS}
        for env in declare:
            self.declare[env].put(spec(env))

    def send(self, env: str, first: int, last: int, *, incarnation: int = 7, begin: int = 0) -> None:
        """Steps first..last of one, in a batch."""
        steps = [tick(seq, env, incarnation=incarnation, begin=begin) for seq in range(first, last + 1)]
        self.logs[env].put(StepBatch(steps=steps))

    def all_live(self, first: int, last: int, envs: Sequence[str] = ENVS) -> None:
        """Ticks first..last of all, the learner catching up in between."""
        for seq in range(first, last + 1):
            self.clock.sleep_until_ns(seq * TICK_NS)
            for env in envs:
                self.send(env, seq, seq)
            self.learner.catch_up()

    def until(self, seconds: float) -> None:
        """Let time pass."""
        self.clock.sleep_until_ns(round(seconds * 1e9))
        self.learner.catch_up()

    def counts(self, name: str) -> tuple[int, ...]:
        """In total, and of each."""
        return tuple(self.ledger.counter(one) for one in (name, *(f"{name}.{env}" for env in ENVS)))


def spec(env: str, **changed: object) -> Spec:
    """Each has the run's T0, 0, and a part of a period."""
    offset_ns = offset_of(ENVS.index(env), len(ENVS), TICK_NS)
    t0 = {"t0_ns": SPEC.t0_ns + offset_ns, "wall_t0_ns": SPEC.wall_t0_ns + offset_ns}
    return msgspec.structs.replace(SPEC, env=env, **{**t0, **changed})


def held(run_dir: RunDir) -> Replay:
    return open_replay(run_dir.learner_dir / "replay", 1000, 2, 1, envs=3)
