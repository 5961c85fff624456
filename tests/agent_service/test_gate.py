"""Which observations get an answer."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from agent_service.gate import Gate
from rtcore.messages import Spec, Step
from tests.agent_service.rig import SPEC
from tests.agent_service.rig import step as plain

TICK_NS = SPEC.tick_ns
HERE: Spec = replace(SPEC, host="here")


def step(tick: int) -> Step:
    """Sent 1 us after its deadline."""
    return replace(plain(tick), sent_ns=tick * TICK_NS + 1_000)


def judge(gate: Gate, one: Step, at_tick: int | None = None) -> str:
    """Received 100 us after the deadline of its tick, or of another."""
    return gate.judge(one, (one.tick if at_tick is None else at_tick) * TICK_NS + 100_000)


def test_each_tick_is_answered_once_and_in_order() -> None:
    gate = Gate(HERE, "here")
    assert [judge(gate, step(tick), 9) for tick in (7, 7, 6, 8, 8, 3, 9)] == [
        "", "repeated", "repeated", "", "repeated", "repeated", "",
    ]  # fmt: skip


def test_a_rehearsal_repeats_the_newest_step_and_no_older_one() -> None:
    gate = Gate(HERE, "here")
    assert judge(gate, step(5)) == ""
    assert judge(gate, replace(step(5), rehearsal=True), 6) == ""
    assert judge(gate, replace(step(4), rehearsal=True), 6) == "repeated"
    assert judge(gate, step(6)) == ""


def test_what_is_not_over_yet_was_not_observed() -> None:
    gate = Gate(HERE, "here")
    assert judge(gate, step(11), 10) == "invalid"
    assert judge(gate, replace(step(10), sent_ns=11 * TICK_NS), 10) == "invalid"
    assert judge(gate, step(10**15), 10) == "invalid"
    assert judge(gate, step(10), 10) == ""


def test_without_a_host_the_future_begins_a_thousand_ticks_ahead() -> None:
    gate = Gate(SPEC, "here")
    assert judge(gate, replace(step(1011), sent_ns=0), 10) == "invalid"
    assert judge(gate, replace(step(1010), sent_ns=0), 10) == ""


def test_on_another_hosts_clock_a_wrong_tick_does_not_silence_the_agent() -> None:
    gate = Gate(HERE, "elsewhere")
    assert judge(gate, step(10**9), 0) == ""
    judged = [judge(gate, step(tick), 10**9) for tick in range(1, 20)]
    assert judged[:15] == ["repeated"] * 15
    assert judged[16:] == [""] * 3


@pytest.mark.parametrize(
    "observation", [np.full(3, np.nan, "<f4"), np.array([0, np.inf, 0], "<f4"), np.zeros(4, "<f4")]
)
def test_an_observation_is_as_long_as_declared_and_of_finite_numbers(observation: np.ndarray) -> None:
    gate = Gate(HERE, "here")
    assert judge(gate, replace(step(1), observation=observation.tobytes())) == "invalid"
    assert judge(gate, step(1)) == ""


def test_the_backlog_behind_a_stall_is_superseded() -> None:
    gate = Gate(HERE, "here")
    assert judge(gate, step(1)) == ""
    assert [judge(gate, step(tick), 10) for tick in (2, 7, 8, 9)] == ["superseded", "superseded", "", ""]
