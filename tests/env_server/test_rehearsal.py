"""Rehearsals: when they are sent, and that their answers never act."""

from __future__ import annotations

import msgspec
import pytest

from env_server.rehearsal import Rehearsal
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Step
from tests.env_server.rig import Rig, run_config
from tests.env_server.scripted import ScriptedAgent

MS = 1_000_000


def a_step(due_ns: int) -> Step:
    steps = Rig(run_config(duration_s=0.02)).run()
    return msgspec.structs.replace(steps[0], due_ns=due_ns)


@pytest.mark.parametrize(
    ("tick_ns", "lead_ns"),
    [(MS, 400_000), (2 * MS, 800_000), (2_500_000, 1_000_000), (3 * MS, 1_200_000), (10 * MS, 1_200_000)],
)
def test_it_is_sent_the_lead_before_the_next_deadline(tick_ns: int, lead_ns: int) -> None:
    clock, hub = VirtualClock(100 * MS), MemoryHub()
    heard = hub.bus("agent", clock).queue(channels.STEP, "env0")
    rehearsal = Rehearsal(hub.bus("env", clock).publisher(channels.STEP, "env0"), clock, tick_ns)
    step = a_step(100 * MS)
    assert rehearsal.perform(step)
    (received,) = heard.drain()
    assert received.message == msgspec.structs.replace(step, rehearsal=True)
    assert received.received_ns == 100 * MS + tick_ns - lead_ns
    clock.advance_ns(1)
    assert not rehearsal.perform(step)  # its moment has passed
    assert heard.drain() == []


def test_above_1_khz_there_is_no_room() -> None:
    clock, hub = VirtualClock(100 * MS), MemoryHub()
    heard = hub.bus("agent", clock).queue(channels.STEP, "env0")
    rehearsal = Rehearsal(hub.bus("env", clock).publisher(channels.STEP, "env0"), clock, MS - 1)
    assert not rehearsal.perform(a_step(100 * MS))
    assert heard.drain() == [] and clock.now_ns() == 100 * MS


def test_the_answer_to_a_rehearsal_neither_acts_nor_hides_the_one_that_does() -> None:
    def answer_and_rehearse(agent: ScriptedAgent, step: Step) -> None:
        agent.answer(step)
        agent.answer(step, value=9.0, rehearsal=True)

    rehearsed, plain = Rig(run_config()), Rig(run_config())
    steps = rehearsed.run(answer_and_rehearse)
    assert steps == plain.run()
    assert rehearsed.counts("missed", "action.stale", "action.invalid") == [0, 0, 0]


def test_only_the_real_answer_is_waited_for_and_it_is_kept_for_the_deadline() -> None:
    rig = Rig(run_config(duration_s=0.05))
    rig.service.announce()
    first, second = list(rig.service.pacer.ticks(Stop()))[:2]
    rig.service.act(first)
    observed = rig.agent.newest()
    rig.agent.answer(observed, rehearsal=True)
    before_ns = rig.clock.now_ns()
    assert not rig.service._await_answer(first.index, 0.004)
    assert rig.clock.now_ns() == before_ns + 4_000_000  # the rehearsal's answer did not end the wait
    rig.agent.answer(observed)
    assert rig.service._await_answer(first.index, 0.004)
    rig.service.act(second)
    assert not rig.service._heard
    assert rig.agent.newest().answered_tick == first.index
