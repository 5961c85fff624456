"""The learner service on a virtual clock, fed by hand over the in-memory bus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from learner.checkpoint import CheckpointError
from learner.power import Levers
from learner.service import LearnerService
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.config import DriftConfig, EnvConfig, LearnerConfig, RunConfig, ScheduleConfig
from rtcore.ledger import Ledger
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Command, Policy, Spec, Step, StepBatch
from rtcore.run_dir import RunDir
from rtcore.spaces import Spaces
from rtcore.weights import verify

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
        hub = MemoryHub()
        self.clock = clock or VirtualClock(0)
        self.ledger = Ledger(channels.LEARNER, 1)
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


@pytest.fixture
def run_dir(tmp_path: Path) -> RunDir:
    return RunDir.create(tmp_path / "run", CONFIG)


@pytest.fixture
def rig(run_dir: RunDir) -> Rig:
    rig = Rig(run_dir)
    rig.specs.put(SPEC)
    return rig


def test_it_publishes_one_iterate_a_unit_in_update_phases_only(rig: Rig) -> None:
    rig.live(0, 79)
    policies = rig.published()
    assert [(p.version, p.window, p.iterate) for p in policies] == [
        (1, 0, 1),
        (2, 0, 2),
        (3, 1, 1),
        (4, 1, 2),
    ]
    # due 0.1 s, the longest a poll can be away, before the unit ends
    assert [p.created_ns // TICK_NS for p in policies] == [9, 19, 49, 59]
    phases = [(n.message.window, n.message.phase, n.message.at_ns // UNIT_NS) for n in rig.windows.drain()]
    assert phases == [(0, "update", 0), (0, "hold", 2), (1, "update", 4), (1, "hold", 6)]
    for policy in policies:
        verify(policy, Spaces.of(SPEC))
    assert rig.ledger.counter("published_in_hold") == 0


def test_critics_go_on_learning_in_the_hold(rig: Rig) -> None:
    rig.live(0, 29)
    # 29 transitions, 5 of them before learning starts; units 0 and 1 improve the policy (14 steps)
    assert rig.ledger.counter("learned") == 29
    assert rig.ledger.counter("gradient_steps") == 24
    assert rig.ledger.counter("policy_steps") == 14


def test_everything_that_waits_before_the_spec_is_learned_after_it(run_dir: RunDir) -> None:
    rig = Rig(run_dir)
    rig.live(0, 9)
    assert rig.ledger.counter("learned") == 0
    rig.specs.put(SPEC)
    rig.live(10, 10)
    assert rig.ledger.counter("learned") == 10


def test_a_repeated_and_a_lost_batch_are_counted(rig: Rig) -> None:
    rig.live(0, 9)
    rig.live(5, 9)
    rig.live(12, 20)  # 10 and 11 are lost
    rig.clock.advance_ns(6 * UNIT_NS)
    rig.learner.catch_up()
    assert (rig.ledger.counter("duplicate"), rig.ledger.counter("gaps")) == (5, 2)
    assert rig.ledger.counter("broken") == 1  # step 12 has no predecessor
    assert rig.ledger.counter("learned") == 9 + 8


def test_an_operators_hold_withholds_and_resume_publishes_again(run_dir: RunDir) -> None:
    always = replace(CONFIG.learner, schedule=ScheduleConfig(l_f=4, gamma_f=1.0))
    rig = Rig(run_dir, replace(CONFIG, learner=always))
    rig.specs.put(SPEC)
    rig.live(0, 12)
    assert rig.order("hold") == "the policy will be held"
    rig.live(13, 32)
    assert [p.created_ns // TICK_NS for p in rig.published()] == [9]
    assert rig.ledger.counter("withheld") == 1  # in the unit in which the order came
    rig.order("resume")
    rig.live(33, 39)
    assert [p.created_ns // TICK_NS for p in rig.published()] == [39]
    reasons = [(n.message.phase, n.message.reason) for n in rig.windows.drain()]
    assert reasons == [("update", "schedule"), ("hold", "operator"), ("update", "operator")]


def test_a_second_learner_of_the_run_goes_on_from_the_checkpoint(rig: Rig, run_dir: RunDir) -> None:
    rig.live(0, 19)
    rig.learner.close()
    second = Rig(run_dir)
    second.specs.put(SPEC)
    second.live(15, 59)  # the log repeats what its cache holds
    assert second.ledger.counter("learned") == 40  # 20..59; nothing is learned twice, nothing left out
    assert second.ledger.counter("duplicate") == 5
    assert [p.version for p in second.published()] == [3, 4]
    assert second.ledger.counter("gradient_steps") == 40  # it has data: it does not wait again
    events = [event.text for event in second.ledger.stats(0).events]
    assert "goes on from the checkpoint: policy 2, 19 transitions in the replay" in events


def test_versions_rise_even_if_the_learner_before_died_without_a_checkpoint(
    rig: Rig, run_dir: RunDir
) -> None:
    rig.live(0, 19)
    second = Rig(run_dir)
    second.specs.put(SPEC)
    second.live(0, 9)
    assert [p.version for p in second.published()] == [3]


def test_an_order_in_the_turn_of_a_publication_comes_first(rig: Rig) -> None:
    rig.live(0, 8)
    rig.order("hold")
    rig.live(9, 9)  # iterate 1 is due here
    assert rig.published() == []
    assert rig.ledger.counter("withheld") == 1


def test_a_checkpoint_of_another_network_is_refused(rig: Rig, run_dir: RunDir) -> None:
    rig.live(0, 19)
    rig.learner.close()
    other = Rig(run_dir, replace(CONFIG, learner=replace(CONFIG.learner, hidden=(8, 4))))
    other.specs.put(SPEC)
    with pytest.raises(CheckpointError, match="8, 4"):
        other.live(20, 21)


def test_after_the_duration_nothing_begins(run_dir: RunDir) -> None:
    rig = Rig(run_dir, replace(CONFIG, duration_s=4.0))
    rig.specs.put(SPEC)
    rig.live(0, 39)
    done = rig.ledger.counter("gradient_steps")
    rig.live(40, 45)  # taken in, but nothing is learned from it any more
    assert rig.ledger.counter("learned") == 45
    assert rig.ledger.counter("gradient_steps") == done
    assert [n.message.window for n in rig.windows.drain()] == [0, 0]


def test_an_unknown_order_is_refused(rig: Rig) -> None:
    reply = rig.learner.command(Command(id="1", verb="stop"))
    assert not reply.ok and "stop" in reply.text


class Working(VirtualClock):
    """Everything takes time: a millisecond from each look at the clock to the next."""

    def now_ns(self) -> int:
        self.advance_ns(1_000_000)
        return super().now_ns()


class Machine:
    """Two cores and an arithmetic library, as the governor sees them."""

    def __init__(self) -> None:
        self.threads: list[int] = []
        self.cores: list[tuple[int, ...]] = []

    @property
    def levers(self) -> Levers:
        return Levers((0, 1), self.threads.append, lambda cores: self.cores.append(tuple(cores)))


GREEDY = replace(CONFIG, learner=replace(CONFIG.learner, utd=1000.0, threads=2))


def test_under_late_steps_it_slows_down_and_then_recovers(run_dir: RunDir) -> None:
    machine = Machine()
    rig = Rig(run_dir, GREEDY, levers=machine.levers, clock=Working(0))
    rig.specs.put(SPEC)
    rig.saturate(0, 19)
    full = rig.saturate(20, 39)
    assert (machine.threads, machine.cores) == ([1, 2], [(1,), (0, 1)])  # the second thread is earned
    pressed = rig.saturate(40, 79, late_every=2) / 2  # per 20 ticks
    assert machine.threads[2:] == [1, 1, 1, 1]
    assert machine.cores[2:] == [(1,)] * 4
    gauges = rig.ledger.stats(0).gauges
    assert (gauges["governor/threads"], gauges["governor/duty"]) == (1, 0.125)
    assert gauges["governor/load"] == 1.0
    assert pressed < full / 2
    slow = rig.saturate(80, 89) * 2
    assert slow < full / 4
    rig.saturate(90, 300)
    assert (machine.threads[-1], machine.cores[-1]) == (2, (0, 1))
    assert rig.saturate(301, 320) == pytest.approx(full, rel=0.1)
    counter = rig.ledger.counter
    assert counter("governor.decisions") == len(machine.threads) - 1
    assert counter("governor.ticks") == 321
    assert 0 < counter("governor.limited_ticks") < 321
    events = [event.text for event in rig.ledger.stats(0).events if event.text.startswith("governor: ")]
    assert events[0] == "governor: begins with 1 of 2 threads, full duty, core 1"
    assert events[1] == "governor: 2 of 2 threads, full duty: 2 s without trouble"
    assert events[2] == (
        "governor: 1 of 2 threads, full duty: p99 of the loop took 100% of the period, deadlines lost 2 times"
    )


@pytest.mark.parametrize("share", ["full", "half"])
def test_a_hold_at_half_power_pauses_half_of_the_time(run_dir: RunDir, share: str) -> None:
    learner = replace(CONFIG.learner, utd=1000.0, hold_learning=share)  # type: ignore[arg-type]
    rig = Rig(run_dir, replace(CONFIG, learner=learner), clock=Working(0))
    rig.specs.put(SPEC)
    rig.saturate(0, 9)
    update, hold = rig.saturate(10, 19), rig.saturate(21, 30)
    assert hold > 0.95 * update if share == "full" else hold < 0.7 * update


@pytest.mark.parametrize("governor", ["on", "off"])
def test_off_or_without_levers_late_steps_change_nothing(run_dir: RunDir, governor: str) -> None:
    machine = Machine()
    config = replace(CONFIG, learner=replace(CONFIG.learner, governor=governor))  # type: ignore[arg-type]
    rig = Rig(run_dir, config, levers=None if governor == "on" else machine.levers)
    rig.specs.put(SPEC)
    rig.live(0, 59, late_every=2)
    assert rig.ledger.counter("gradient_steps") == 54  # one per transition after the first five
    assert (machine.threads, machine.cores) == ([], [])
    assert not any(name.startswith("governor") for name in rig.ledger.stats(0).gauges)


def test_a_system_that_does_not_move_it_is_told_of_and_lived_with(run_dir: RunDir) -> None:
    def refuse(cores: Sequence[int]) -> None:
        raise PermissionError(f"not {cores}")

    rig = Rig(run_dir, GREEDY, levers=Levers((0, 1), lambda threads: None, refuse), clock=Working(0))
    rig.specs.put(SPEC)
    assert rig.saturate(0, 9) > 0
    events = [event.text for event in rig.ledger.stats(0).events]
    assert "governor: the learner keeps its cores: not (1,)" in events
