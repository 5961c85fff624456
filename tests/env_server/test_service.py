"""The service in virtual time: every count and stamp is exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from env_server.worlds.registry import make_world, resolve
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.config import DriftConfig, EnvConfig, RecorderConfig, RunConfig
from rtcore.lifecycle import Stop
from rtcore.messages import Command, Spec, Step, StepBatch
from tests.env_server.rig import MISSES, START_NS, TICK_NS, Rig, run_config, silent
from tests.env_server.scripted import ScriptedAgent, ScriptedWorld


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
    assert rig.counts("missed", *MISSES, "overruns", "skipped") == [0] * (3 + len(MISSES))
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
    assert world.acted == pytest.approx([k / 1000 for k in range(9)])
    assert [np.frombuffer(step.action, np.float32)[0] for step in steps[1:]] == pytest.approx(world.acted)


def test_a_delayed_action_acts_later_and_the_step_has_both() -> None:
    world = ScriptedWorld()
    steps = Rig(run_config(duration_s=0.1, action_delay_ticks=2), world).run()
    assert world.acted == pytest.approx([0, 0, *(k / 1000 for k in range(7))])
    assert np.frombuffer(steps[5].action, np.float32) == pytest.approx([0.002])
    assert np.frombuffer(steps[5].decision, np.float32) == pytest.approx([0.004])
    assert steps[5].answered_tick == 4


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


@pytest.mark.parametrize("record", [True, False])
def test_the_start_waits_for_all_that_belong_to_the_run(record: bool) -> None:
    rig = Rig(replace(run_config(start_wait_s=15.0), recorder=RecorderConfig(record=record)))
    late = rig.hub.bus("late", rig.clock)
    if record:
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
    said = "starting without learner and recorder after 1.23 s"
    assert [event.text for event in rig.ledger.stats(0).events] == [said]


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
    # T0 is 100 ms after the announcement, the last deadline 29 ticks later; then half a tick for an answer
    assert rig.clock.now_ns() == START_NS + 100_000_000 + 29 * TICK_NS + TICK_NS // 2
