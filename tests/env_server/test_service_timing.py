"""Deadlines kept, missed and lost, in virtual time to the nanosecond: what acts, is observed, is blamed.

The world counts ticks and remembers actions; the agent answers observation k with k thousandths.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from rtcore.config import MissPolicy
from rtcore.messages import Step
from tests.env_server.rig import TICK_NS, Rig, run_config
from tests.env_server.scripted import ScriptedAgent, ScriptedWorld

MS = 1_000_000
Answer = Callable[[ScriptedAgent, Step], None]


def but_not(*ticks: int) -> Answer:
    """An agent that never answers these observations."""

    def answer(agent: ScriptedAgent, step: Step) -> None:
        if step.tick not in ticks:
            agent.answer(step)

    return answer


def late_with(tick: int, **excuses: int) -> Answer:
    """An agent that answers observation `tick` right after its deadline, with what it has to say for itself,
    and then the next one at once."""
    late: list[Step] = []

    def answer(agent: ScriptedAgent, step: Step) -> None:
        if step.tick == tick:
            late.append(step)
            return
        if step.tick == tick + 1:
            agent.answer(late[0], received_ns=late[0].sent_ns + MS, **excuses)
        agent.answer(step)

    return answer


@pytest.mark.parametrize(
    ("on_miss", "fallbacks", "thousandths"),
    [
        ("hold", ["hold"] * 4, [0, 1, 2, 2, 2, 2, 2, 7, 8]),
        ("neutral", ["neutral"] * 4, [0, 1, 2, 0, 0, 0, 0, 7, 8]),
        ("hold_then_neutral", ["hold", "hold", "neutral", "neutral"], [0, 1, 2, 2, 2, 0, 0, 7, 8]),
    ],
)
@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_fallback_decides_at_the_missed_deadline_and_acts_after_the_delay(
    delay: int, on_miss: MissPolicy, fallbacks: list[str], thousandths: list[int]
) -> None:
    world = ScriptedWorld()
    rig = Rig(run_config(duration_s=0.1, on_miss=on_miss, hold_ticks=2, action_delay_ticks=delay), world)
    steps = rig.run(but_not(3, 4, 5, 6))
    missed = [step for step in steps if step.missed]
    assert [step.tick for step in missed] == [4, 5, 6, 7]
    assert [step.fallback for step in missed] == fallbacks
    decided = [np.frombuffer(step.decision, np.float32)[0] for step in steps[1:]]
    assert decided == pytest.approx([k / 1000 for k in thousandths])
    assert world.acted == pytest.approx([0] * delay + [k / 1000 for k in thousandths][: 9 - delay])
    assert [np.frombuffer(step.action, np.float32)[0] for step in steps[1:]] == pytest.approx(world.acted)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_the_observation_ends_with_the_last_decisions_the_fallbacks_among_them(delay: int) -> None:
    rig = Rig(run_config(duration_s=0.08, action_delay_ticks=delay, observe_actions=3))
    steps = rig.run(but_not(3, 4))
    # own part: ticks since the reset, and what really acted; then three decisions, the newest first
    decided = [0, 1, 2, 2, 2, 5, 6]
    for k, step in enumerate(steps):
        past = [*reversed([0, 0, 0, *decided[:k]])][:3]
        acted = decided[k - 1 - delay] if k > delay else 0
        expected = [k, acted / 1000, *(value / 1000 for value in past)]
        assert np.frombuffer(step.observation, np.float32) == pytest.approx(expected), k


def test_a_delay_counts_executed_ticks_across_lost_deadlines() -> None:
    world = ScriptedWorld()
    rig = Rig(run_config(duration_s=0.12, episode_steps=100, action_delay_ticks=1), world)
    # the steps at 30 and 80 ms take 35 and 25 ms: two deadlines lost, then one
    world.on_step = lambda number: rig.clock.advance_ns({3: 35 * MS, 6: 25 * MS}.get(number, 0))
    steps = rig.run()
    assert [step.tick for step in steps] == [0, 1, 2, 3, 6, 7, 8, 10, 11]
    assert [step.skipped for step in steps] == [0, 0, 0, 0, 2, 0, 0, 1, 0]
    assert [step.woke_ns - step.due_ns for step in steps] == [0, 0, 0, 0, 5 * MS, 0, 0, 5 * MS, 0]
    assert [step.answered_tick for step in steps] == [-1, 0, 1, 2, 3, 6, 7, 8, 10]
    assert world.acted == pytest.approx([0, 0, 0.001, 0.002, 0.003, 0.006, 0.007, 0.008])
    assert rig.counts("ticks", "overruns", "skipped", "missed") == [9, 2, 3, 0]


@pytest.mark.parametrize(
    ("excuses", "cause"),
    [
        ({}, "agent_late"),
        ({"swap_ns": 6 * MS}, "policy_swap"),
        ({"collector_ns": 6 * MS}, "collector_pause"),
        ({"starved_ns": 6 * MS}, "agent_stalled"),
    ],
)
def test_a_late_answer_tells_its_own_cause(excuses: dict[str, int], cause: str) -> None:
    rig = Rig(run_config(duration_s=0.1))
    steps = rig.run(late_with(3, **excuses))
    assert [(step.tick, step.cause) for step in steps if step.missed] == [(4, cause)]
    assert rig.causes() == {cause: 1}


def test_a_late_answer_is_heard_though_the_next_one_came_right_behind_it() -> None:
    rig = Rig(run_config(duration_s=0.1))
    steps = rig.run(late_with(3))
    assert rig.counts("missed", "action.stale") == [1, 1]
    assert (steps[5].missed, steps[5].answered_tick, steps[5].loop_ns) == (False, 4, 0)
    loop = rig.ledger.histogram("loop")
    assert (loop.count, loop.quantile(1.0)) == (9, TICK_NS)


def test_an_answer_to_what_was_not_asked_yet_tells_nothing_about_later_misses() -> None:
    rig = Rig(run_config(duration_s=0.1))

    def answer(agent: ScriptedAgent, step: Step) -> None:
        if step.tick != 6:
            agent.answer(step, tick=99 if step.tick == 5 else None)

    steps = rig.run(answer)
    assert [(step.tick, step.cause) for step in steps if step.missed] == [(6, "agent_late"), (7, "transport")]


def test_a_stop_of_the_env_server_is_its_own_fault_though_the_answer_was_late() -> None:
    world = ScriptedWorld()
    rig = Rig(run_config(duration_s=0.1, episode_steps=100), world)

    def stopped(number: int) -> None:
        if number == 4:  # after it took the action, and before the step went out
            rig.clock.advance_ns(32 * MS)
            rig.resumed_ns.append(rig.clock.now_ns())

    world.on_step = stopped
    steps = rig.run(late_with(4))
    assert [(step.tick, step.cause, step.skipped) for step in steps if step.missed or step.skipped] == [
        (7, "env_late", 2)
    ]
    assert rig.causes() == {"env_late": 1}


def test_a_stop_of_the_agent_is_the_cause_of_all_that_it_missed() -> None:
    rig = Rig(run_config(duration_s=0.2, episode_steps=100))
    resumed_ns: list[int] = []

    def answer(agent: ScriptedAgent, step: Step) -> None:
        if 5 <= step.tick < 10:
            return
        if step.tick == 10:
            resumed_ns.append(rig.clock.now_ns() - 1)
        agent.answer(step, resumed_ns=resumed_ns[0] if resumed_ns else 0)

    steps = rig.run(answer)
    assert [(step.tick, step.cause) for step in steps if step.missed] == [
        (tick, "agent_stalled") for tick in range(6, 11)
    ]


def test_the_log_waits_for_the_verdict_and_the_real_time_path_does_not() -> None:
    rig = Rig(run_config(duration_s=0.1))
    seen: list[Step] = []
    logged: list[int] = []  # after each tick
    late = late_with(3)

    def answer(agent: ScriptedAgent, step: Step) -> None:
        seen.append(step)
        late(agent, step)
        rig.service.journal.flush()
        logged.append(sum(len(received.message.steps) for received in rig.log_copy.drain()))

    steps = rig.run(answer)
    assert logged == [1, 1, 1, 1, 0, 2, 1, 1, 1, 1]
    assert [step.tick for step in seen] == [step.tick for step in steps]
    assert [step.cause for step in seen] == [""] * 10
    assert [step.cause for step in steps] == ["", "", "", "", "agent_late", "", "", "", "", ""]


def test_a_last_miss_has_a_cause_too() -> None:
    rig = Rig(run_config(duration_s=0.1))
    steps = rig.run(but_not(7, 8))
    assert [(step.tick, step.cause) for step in steps if step.missed] == [(8, "transport"), (9, "transport")]
    rig = Rig(run_config(duration_s=0.1))
    rig.run(but_not(7, 8, 9))
    assert rig.causes() == {"agent_absent": 2}
