"""The learner service on a virtual clock, fed by hand over the in-memory bus.

A rig that is left without `learner.close()` is as good as killed: files are mapped, nothing waits in it.
"""

from __future__ import annotations

import msgspec
import numpy as np

from learner.power import Levers
from learner.service import LearnerService
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.config import DriftConfig, EnvConfig, LearnerConfig, RunConfig, ScheduleConfig
from rtcore.ledger import Ledger
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Command, Policy, Spec, Step, StepBatch
from rtcore.run_dir import RunDir
from rtcore.tally import Tally

TICK_NS, UNIT_NS = 100_000_000, 1_000_000_000  # ten ticks a unit
SPEC = Spec(
    env="env0", env_id="test", incarnation=7, t0_ns=0, wall_t0_ns=0, tick_ns=TICK_NS, unit_ns=UNIT_NS,
    observation_dim=2, action_dim=1, action_low=[-4.0], action_high=[0.0],
)  # fmt: skip
CONFIG = RunConfig(
    duration_s=0.0,
    env=EnvConfig(id="pointmass", hz=10.0, drift=DriftConfig(kind="none")),
    learner=LearnerConfig(
        hidden=(8, 8), batch=16, learning_starts=5, replay_capacity=1000,
        schedule=ScheduleConfig(l_f=4, gamma_f=0.5),
    ),
)  # fmt: skip
# Windows of 4 units: 2 update, 2 hold.


def step(seq: int, *, reset: bool = False, late: bool = False) -> Step:
    observation = np.array([seq, -seq], np.float32).tobytes()
    action = b"" if reset else np.array([-4.0 + seq % 5], np.float32).tobytes()
    return Step(
        env="env0", incarnation=7, seq=seq, tick=seq, episode=0, episode_tick=0 if reset else seq,
        unit=seq // 10, due_ns=seq * TICK_NS, woke_ns=seq * TICK_NS, sent_ns=seq * TICK_NS,
        observation=observation, reward=1.0,
        terminated=False, truncated=False, action=action, decision=action, answered_tick=seq - 1,
        policy_version=0, missed=late, fallback="hold" if late else "", cause="agent_late" if late else "",
        skipped=0, loop_ns=-1 if late else 0, reaction_ns=-1,
        drift=0.0, position=b"",
    )  # fmt: skip


class Rig:
    """A learner, its clock, and the other ends."""

    def __init__(
        self,
        run_dir: RunDir,
        config: RunConfig = CONFIG,
        *,
        levers: Levers | None = None,
        clock: VirtualClock | None = None,
    ) -> None:
        hub = self.hub = MemoryHub()
        self.clock = clock or VirtualClock(0)
        life = run_dir.next_incarnation(channels.LEARNER, 1)
        self.ledger = Ledger(channels.LEARNER, life, Tally.create(run_dir.tally_path(channels.LEARNER, life)))
        env = hub.bus(channels.ENV_SERVER, self.clock)
        self.specs, self.log = env.publisher(channels.SPEC, "env0"), env.publisher(channels.LOG, "env0")
        self.learner = LearnerService(
            config, run_dir, hub.bus(channels.LEARNER, self.clock), self.clock, self.ledger, levers=levers
        )
        agent = hub.bus(channels.AGENT, self.clock)
        self.policies, self.windows = agent.queue(channels.POLICY), agent.queue(channels.WINDOW)

    def live(self, first: int, last: int, *, late_every: int = 0) -> None:
        """Ticks first..last, one batch each, the learner catching up in between; some were missed."""
        for seq in range(first, last + 1):
            self.clock.sleep_until_ns(seq * TICK_NS)
            late = late_every > 0 and seq % late_every == 0
            self.log.put(StepBatch(steps=[step(seq, reset=seq == 0, late=late)]))
            self.learner.catch_up()

    def saturate(self, first: int, last: int, *, late_every: int = 0) -> int:
        """The same, but the learner makes what steps it can in each tick's time; returns how many."""
        before = self.ledger.counter("gradient_steps")
        for seq in range(first, last + 1):
            self.clock.sleep_until_ns(seq * TICK_NS)
            late = late_every > 0 and seq % late_every == 0
            self.log.put(StepBatch(steps=[step(seq, reset=seq == 0, late=late)]))
            while self.clock.now_ns() < (seq + 1) * TICK_NS - 15_000_000:
                self.learner.step()
        return self.ledger.counter("gradient_steps") - before

    def published(self) -> list[Policy]:
        return [received.message for received in self.policies.drain()]

    def order(self, verb: str) -> str:
        command = msgspec.convert({"id": verb, "verb": verb}, dict)
        return self.learner.command(Command(**command)).text
