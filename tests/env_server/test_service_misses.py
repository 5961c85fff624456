"""What goes wrong in a run, in virtual time: misses, overruns and bad values, counted with their causes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rtcore.messages import Step
from tests.env_server.rig import TICK_NS, Rig, run_config, silent
from tests.env_server.scripted import ScriptedAgent, ScriptedWorld


def test_an_absent_agent_is_a_miss_at_every_tick_but_the_resets() -> None:
    rig = Rig(run_config())
    steps = rig.run(silent)
    assert rig.counts("ticks", "resets", "missed") == [100, 10, 90]
    assert rig.causes() == {"agent_absent": 90}
    assert {step.fallback for step in steps if step.missed} == {"neutral"}
    assert [event.text for event in rig.ledger.stats(0).events[1:]] == ["tick 1: the agent is absent"]


def test_a_late_answer_is_a_miss_and_its_latency_is_known() -> None:
    rig = Rig(run_config(duration_s=0.1))
    late: list[Step] = []

    def answer(agent: ScriptedAgent, step: Step) -> None:
        if step.tick in (3, 4):
            late.append(step)
        if step.tick == 4:
            agent.answer(late[0], received_ns=late[0].sent_ns + 1)  # one tick late
        elif step.tick != 3:
            agent.answer(step)

    steps = rig.run(answer)
    assert [step.tick for step in steps if step.missed] == [4, 5]
    # answering 3 took the agent all of tick 4; that 4 ever reached it, nothing tells
    assert [step.cause for step in steps if step.missed] == ["agent_late", "transport"]
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
    assert rig.causes() == {"agent_late": 3}
    assert world.acted == pytest.approx([0, 0.001, 0.001, 0.001, 1.0, 1.0, 0.006, 0.007, 0.008])


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
    assert [(step.tick, step.cause) for step in steps if step.missed] == [(6, "env_late"), (10, "transport")]
    assert rig.causes() == {"env_late": 1, "transport": 1}


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
