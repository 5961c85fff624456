"""The service in virtual time: every count, stamp and cause is exact."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from env_server.service import EnvService
from env_server.world import World
from env_server.worlds import make_world, resolve
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.config import DriftConfig, EnvConfig, RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Command, Spec, Step, StepBatch
from tests.env_server.scripted import ScriptedAgent, ScriptedWorld

START_NS = 1_000_000_000
TICK_NS = 10_000_000  # 100 Hz
MISSES = ("missed.agent_late", "missed.agent_absent", "missed.env_late")


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
        self.service = EnvService(
            config, self.world, self.bus, self.clock, self.ledger, 77, wall_ns=lambda: 5_000_000_000
        )
        self.agent = ScriptedAgent(self.hub.bus("agent", self.clock), self.clock)
        self.reader = self.hub.bus("reader", self.clock)
        self.log = self.reader.queue(channels.LOG, "*")

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

    def counts(self, *names: str) -> list[int]:
        return [self.ledger.counter(name) for name in names]


def silent(_agent: ScriptedAgent, _step: Step) -> None:
    """An agent that is not there."""


def spec_of(rig: Rig) -> Spec:
    received = rig.reader.latest(channels.SPEC, "env0").take()
    assert received is not None
    return received.message


def test_the_spec_says_what_the_run_is() -> None:
    rig = Rig(run_config(observe_actions=2, action_delay_ticks=1))
    rig.service.announce()
    assert spec_of(rig) == Spec(
        env="env0", env_id="pointmass", incarnation=77, t0_ns=START_NS + 100_000_000,
        wall_t0_ns=5_100_000_000, tick_ns=TICK_NS, unit_ns=100_000_000, observation_dim=4, action_dim=1,
        action_low=[-1.0], action_high=[1.0], action_delay_ticks=1, native_period_ns=50_000_000,
        scene="point",
    )  # fmt: skip


def test_counts_reconcile_and_nothing_is_missed() -> None:
    rig = Rig(run_config())
    steps = rig.run()
    # 100 ticks in episodes of a reset and 9 steps
    assert rig.counts("ticks", "resets", "produced", "episodes") == [100, 10, 90, 10]
    assert rig.counts("missed", *MISSES, "overruns", "skipped") == [0] * 6
    assert rig.counts("action.stale", "action.invalid", "action.clipped") == [0] * 3
    assert [step.seq for step in steps] == [step.tick for step in steps] == list(range(100))
    stats = rig.ledger.stats(0, final=True)
    assert [(episode.episode, episode.length) for episode in stats.returns] == [(k, 9) for k in range(10)]


def test_a_step_tells_the_whole_story() -> None:
    steps = Rig(run_config()).run()
    reset, first, tenth = steps[0], steps[1], steps[10]
    t0_ns = START_NS + 100_000_000
    assert (reset.episode_tick, reset.reward, reset.action, reset.decision) == (0, 0.0, b"", b"")
    assert (reset.answered_tick, reset.policy_version, reset.missed, reset.loop_ns) == (-1, -1, False, -1)
    assert (first.due_ns, first.woke_ns, first.sent_ns) == (t0_ns + TICK_NS,) * 3
    assert (first.answered_tick, first.policy_version, first.missed, first.cause) == (0, 5, False, "")
    assert (first.loop_ns, first.reaction_ns) == (0, 300)
    assert np.frombuffer(first.observation, np.float32).tolist() == [1, 0]
    assert np.frombuffer(first.position, np.float64).tolist() == [1]
    assert (tenth.episode, tenth.episode_tick, tenth.unit, tenth.drift) == (1, 0, 1, 10.0)
    assert steps[9].truncated and not steps[9].terminated
    assert [step.unit for step in steps] == [k // 10 for k in range(100)]
    assert [step.reward for step in steps if step.episode_tick] == [
        step.unit for step in steps if step.episode_tick
    ]


def test_the_real_time_path_carries_the_same_steps_as_the_log() -> None:
    rig = Rig(run_config(duration_s=0.2))
    seen: list[Step] = []

    def watch(agent: ScriptedAgent, step: Step) -> None:
        seen.append(step)
        agent.answer(step)

    assert rig.run(watch) == seen


def test_what_acts_is_the_answer_to_the_step_before() -> None:
    world = ScriptedWorld()
    steps = Rig(run_config(duration_s=0.1), world).run()
    assert world.actions == pytest.approx([k / 1000 for k in range(9)])
    assert [np.frombuffer(step.action, np.float32)[0] for step in steps[1:]] == pytest.approx(world.actions)


def test_a_delayed_action_acts_later_and_the_step_has_both() -> None:
    world = ScriptedWorld()
    steps = Rig(run_config(duration_s=0.1, action_delay_ticks=2), world).run()
    assert world.actions == pytest.approx([0, 0, *(k / 1000 for k in range(7))])
    assert np.frombuffer(steps[5].action, np.float32) == pytest.approx([0.002])
    assert np.frombuffer(steps[5].decision, np.float32) == pytest.approx([0.004])
    assert steps[5].answered_tick == 4


def test_an_absent_agent_is_a_miss_at_every_tick_but_the_resets() -> None:
    rig = Rig(run_config())
    steps = rig.run(silent)
    assert rig.counts("ticks", "resets", "missed", *MISSES) == [100, 10, 90, 0, 90, 0]
    assert {step.fallback for step in steps if step.missed} == {"neutral"}
    assert [event.text for event in rig.ledger.stats(0).events[1:]] == ["tick 1: the agent is absent"]


def test_a_late_answer_is_a_miss_and_its_latency_is_known() -> None:
    rig = Rig(run_config(duration_s=0.1))
    late: list[Step] = []

    def answer(agent: ScriptedAgent, step: Step) -> None:
        if step.tick in (3, 4):
            late.append(step)
        if step.tick == 4:
            agent.answer(late[0])  # one tick too late, and 4 stays unanswered
        elif step.tick != 3:
            agent.answer(step)

    steps = rig.run(answer)
    assert [step.tick for step in steps if step.missed] == [4, 5]
    assert {step.cause for step in steps if step.missed} == {"agent_late"}
    assert {(step.fallback, step.answered_tick) for step in steps if step.missed} == {("hold", 2)}
    assert rig.counts("missed", "action.stale") == [2, 1]
    assert steps[5].loop_ns == -1
    loop = rig.ledger.histogram("loop")
    assert (loop.count, loop.quantile(1.0)) == (8, TICK_NS)


def test_bad_actions_are_counted_and_never_act() -> None:
    world = ScriptedWorld()
    rig = Rig(run_config(duration_s=0.1), world)
    values = {2: math.nan, 3: math.inf, 4: 5.0}

    def answer(agent: ScriptedAgent, step: Step) -> None:
        agent.answer(step, value=values.get(step.tick), tick=99 if step.tick == 5 else None)

    rig.run(answer)
    assert rig.counts("missed", "action.invalid", "action.clipped") == [3, 3, 1]
    assert world.actions == pytest.approx([0, 0.001, 0.001, 0.001, 1.0, 1.0, 0.006, 0.007, 0.008])


def test_an_overrun_loses_deadlines_and_the_drift_stays_on_the_wall_clock() -> None:
    world = ScriptedWorld()
    rig = Rig(run_config(duration_s=0.4, episode_steps=1000), world)
    # tick 5 takes from 50 to 76 ms after T0: tick 6 is lost, and tick 7 begins 6 ms late
    world.on_step = lambda number: rig.clock.advance_ns(26_000_000 if number == 5 else 0)
    steps = rig.run()
    assert [step.tick for step in steps[4:9]] == [4, 5, 7, 8, 9]
    assert [step.skipped for step in steps[4:9]] == [0, 0, 1, 0, 0]
    assert steps[6].woke_ns - steps[6].due_ns == 6_000_000
    assert [step.seq for step in steps] == list(range(39))
    assert [step.unit for step in steps] == [step.tick // 10 for step in steps]
    assert [step.drift for step in steps] == [10.0 * (step.tick // 10) for step in steps]
    assert rig.counts("ticks", "skipped", "overruns", "produced", "resets") == [39, 1, 1, 38, 1]
    assert steps[6].answered_tick == 5 and not steps[6].missed
    pacing = rig.ledger.histogram("pacing")
    assert (pacing.count, pacing.quantile(1.0)) == (39, 6_000_000)


def test_the_unit_is_that_of_the_deadline_however_late_the_tick() -> None:
    world = ScriptedWorld()
    rig = Rig(run_config(duration_s=0.2, episode_steps=1000, unit_s=0.105), world)
    world.on_step = lambda number: rig.clock.advance_ns(16_000_000 if number == 9 else 0)
    late = rig.run()[10]  # due 100 ms after T0, begun at 106 ms, in unit 1 by then
    assert (late.tick, late.woke_ns - late.due_ns, late.unit, late.drift) == (10, 6_000_000, 0, 0.0)


def test_misses_after_a_late_step_are_the_env_servers_own() -> None:
    world = ScriptedWorld()
    rig = Rig(run_config(duration_s=0.2, episode_steps=1000), world)
    world.on_step = lambda number: rig.clock.advance_ns(6_000_000 if number == 5 else 0)

    def answer(agent: ScriptedAgent, step: Step) -> None:
        if step.tick not in (5, 9):  # 5 left 6 ms late
            agent.answer(step)

    steps = rig.run(answer)
    assert [(step.tick, step.cause) for step in steps if step.missed] == [(6, "env_late"), (10, "agent_late")]
    assert rig.counts("missed", *MISSES) == [2, 1, 0, 1]


def test_deadlines_lost_at_the_very_end_are_counted() -> None:
    world = ScriptedWorld()
    rig = Rig(run_config(duration_s=0.1, episode_steps=1000), world)
    world.on_step = lambda number: rig.clock.advance_ns(45_000_000 if number == 8 else 0)
    steps = rig.run()
    assert len(steps) == 9
    assert rig.counts("ticks", "skipped", "overruns") == [9, 1, 1]


def test_a_broken_world_is_counted_and_told() -> None:
    rig = Rig(run_config(duration_s=0.1), ScriptedWorld(breaks_at=3))
    steps = rig.run()
    assert all(np.isfinite(np.frombuffer(step.observation, np.float32)).all() for step in steps)
    assert rig.counts("world.broken", "resets", "episodes") == [1, 2, 1]
    assert "tick 3: the world gave NaN or Inf; reset" in [event.text for event in rig.ledger.stats(0).events]


@pytest.mark.parametrize(("duration_s", "ticks"), [(0.5, 50), (0.01, 1), (0.001, 1)])
def test_a_run_has_exactly_its_ticks(duration_s: float, ticks: int) -> None:
    assert len(Rig(run_config(duration_s=duration_s)).run()) == ticks


def test_without_a_duration_it_runs_until_stopped() -> None:
    rig, stop = Rig(run_config(duration_s=0.0)), Stop()

    def answer(agent: ScriptedAgent, step: Step) -> None:
        agent.answer(step)
        if step.tick == 321:
            stop.set("enough")

    assert len(rig.run(answer, stop)) == 322


@pytest.mark.parametrize(
    "env",
    [EnvConfig(id="pointmass"), EnvConfig(id="HalfCheetah-v5"), EnvConfig(id="Pendulum-v1")],
    ids=lambda env: env.id,
)
def test_two_runs_are_byte_equal_and_another_seed_is_not(env: EnvConfig) -> None:
    drift = DriftConfig(kind="none" if env.id == "Pendulum-v1" else "sine")
    env = resolve(replace(env, episode_steps=20, drift=drift))

    def log(seed: int) -> bytes:
        config = RunConfig(seed=seed, duration_s=3.0, env=env)
        world = make_world(env, seed)
        steps = Rig(config, world).run()
        world.close()
        return msgspec.msgpack.encode(steps)

    assert log(7) == log(7) != log(8)


def test_the_log_goes_out_in_time_and_whole() -> None:
    rig = Rig(run_config(duration_s=1.0))
    rig.service.announce()
    batches: list[StepBatch] = []
    for tick in rig.service.pacer.ticks(Stop()):
        rig.service.step(tick)
        rig.service.journal.flush_due(rig.clock.now_ns())
        batches += [received.message for received in rig.log.drain()]
        waiting = rig.service._seq - sum(len(batch.steps) for batch in batches)
        assert waiting < 5  # 50 ms at 100 Hz


def command(verb: str) -> Command:
    return Command(id="1", verb=verb)  # type: ignore[arg-type]


def test_commands() -> None:
    rig, stop = Rig(run_config(duration_s=0.1)), Stop()
    rig.bus.serve(channels.ENV_SERVER, lambda command: rig.service.command(command, stop))
    assert rig.service.command(command("status"), stop).text == "waiting for the agent and the learner"
    rig.run(silent)
    reply = rig.service.command(command("status"), stop)
    assert (reply.ok, reply.text) == (True, "10 ticks, 1 episodes, 9 missed")
    reply = rig.service.command(command("hold"), stop)
    assert (reply.ok, reply.text) == (False, "the env server knows no 'hold'")
    assert not stop.is_set()
    assert rig.reader.ask(channels.ENV_SERVER, command("stop")).ok
    assert (stop.is_set(), stop.reason) == (True, "stopped by command")


class ImpatientStop(Stop):
    """A stop whose waits move a virtual clock."""

    def __init__(self, clock: VirtualClock, on_wait: Callable[[], None] = lambda: None) -> None:
        super().__init__()
        self.clock = clock
        self.on_wait = on_wait

    def wait(self, timeout_s: float) -> bool:
        self.clock.advance_ns(round(timeout_s * 1e9))
        self.on_wait()
        return self.is_set()


def test_the_start_waits_for_agent_and_learner_only() -> None:
    rig = Rig(run_config(start_wait_s=15.0))
    late = rig.hub.bus("late", rig.clock)
    rig.hub.bus("recorder", rig.clock).declare_alive(channels.RECORDER)
    rig.reader.declare_alive(channels.AGENT)

    def arrive() -> None:
        if rig.clock.now_ns() >= START_NS + 2_000_000_000:
            late.declare_alive(channels.LEARNER)

    rig.service.wait_for_peers(ImpatientStop(rig.clock, arrive))
    assert rig.clock.now_ns() == START_NS + 2_000_000_000
    assert rig.ledger.stats(0).events == []


def test_the_start_gives_up_waiting_and_says_for_whom() -> None:
    rig = Rig(run_config(start_wait_s=1.23))
    rig.reader.declare_alive(channels.AGENT)
    rig.service.wait_for_peers(ImpatientStop(rig.clock))
    assert rig.clock.now_ns() == START_NS + 1_230_000_000
    assert [event.text for event in rig.ledger.stats(0).events] == ["starting without learner after 1.23 s"]


def test_a_stop_while_waiting_ends_the_run_before_it_begins() -> None:
    rig = Rig(run_config())
    stop = ImpatientStop(rig.clock)
    stop.on_wait = lambda: stop.set("SIGINT")
    rig.service.run(stop)
    rig.service.close()
    assert rig.counts("ticks") == [0]
    assert [(received.message.steps, received.message.last) for received in rig.log.drain()] == [([], True)]


def test_run_waits_announces_and_ticks() -> None:
    rig = Rig(run_config(duration_s=0.3, start_wait_s=0.0))
    rig.service.run(Stop())
    rig.service.close()
    assert rig.counts("ticks", "missed.agent_absent") == [30, 27]
    # T0 is 100 ms after the announcement, and the last deadline 29 ticks later
    assert rig.clock.now_ns() == START_NS + 100_000_000 + 29 * TICK_NS
