"""What a decoded message must be, field by field: each case is one field away from what is right."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace

from rtcore import admission, channels
from rtcore.channels import Channel
from rtcore.config import ScheduleConfig
from rtcore.messages import Command, EpisodeReturn, Event, Message, StepBatch
from tests.rtcore.bus_samples import SAMPLES, policy, spec, stats, step, window
from tests.rtcore.steps import floats

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("channel", channels.TABLE, ids=lambda channel: channel.name)
def test_what_the_processes_say_is_admitted(channel: Channel[Message]) -> None:
    channel.check(SAMPLES[channel.name][1])


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"observation_dim": 65_537}, r"'observation_dim' = 65537: must be within \[0, 65536\]"),
        ({"action_dim": 1 << 60}, "'action_dim'"),
        ({"action_dim": 2}, "action_low: 1 numbers, action_dim = 2"),
        ({"action_low": [NAN]}, "action_low: must be within"),
        ({"action_high": [INF]}, "action_high: must be within"),
        ({"action_high": [-1.0]}, "action_low: must be below"),
        ({"action_high": [-2.0]}, "action_low: must be below"),
        ({"states": 5}, "states = 5, actions = 0: both or neither"),
        ({"states": 1 << 40, "actions": 2}, "'states'"),
        ({"action_delay_ticks": 1 << 20}, "'action_delay_ticks'"),
        ({"t0_ns": -(1 << 63)}, "'t0_ns'"),
        ({"env_id": "x" * 257}, "a name of 257 characters"),
    ],
)
def test_a_world_that_cannot_be(fields: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        admission.check_spec(replace(spec(), **fields))


def test_the_only_action_of_a_finite_world_has_no_range() -> None:
    admission.check_spec(replace(spec(), states=3, actions=1, action_low=[0.0], action_high=[0.0]))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"observation_dim": 3}, "observation_dim = 3: the world has 2"),
        ({"tick_ns": 1}, "tick_ns = 1: the world has 50000000"),
        ({"action_low": [-2.0]}, "action_low"),
    ],
)
def test_another_world_is_no_later_incarnation(fields: dict[str, Any], reason: str) -> None:
    admission.check_same_world(replace(spec(), incarnation=9, t0_ns=77, host="b"), spec())
    with pytest.raises(ValueError, match=reason):
        admission.check_same_world(replace(spec(), **fields), spec())


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: [step(1), step(0)], "seq 0, tick 3 after 1, 4"),
        (lambda: [step(1), replace(step(2), tick=3)], "seq 2, tick 3 after 1, 4"),
        (lambda: [step(1), step(2, incarnation=2)], "several incarnations"),
        (lambda: [step(1), replace(step(2), env="env1")], "several incarnations"),
        (lambda: [replace(step(1), tick=(1 << 40) + 1)], "at most the tick"),
        (lambda: [replace(step(1), seq=5, tick=4)], "seq 5 at tick 4"),
        (lambda: [replace(step(1), reward=NAN)], "not finite"),
        (lambda: [step(0), replace(step(1), drift=-INF)], "not finite"),
        (lambda: [replace(step(1), physics=[1.0, INF])], "not finite"),
        (lambda: [replace(step(1), observation=floats(1, NAN))], "not finite"),
        (lambda: [step(0), replace(step(1), decision=floats(INF))], "not finite"),
        (lambda: [replace(step(1), action=b"123")], "no whole number of numbers"),
        (lambda: [step(0)] * 10_001, "10001 steps: at most 10000"),
    ],
)
def test_steps_that_cannot_be(make: Callable[[], list[Any]], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        admission.check_batch(StepBatch(steps=make()))


def test_a_batch_may_be_empty_repeat_itself_and_skip() -> None:
    for steps in ([], [step(3), step(3)], [step(3), step(9)]):
        admission.check_batch(StepBatch(steps=steps))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"hidden": [0]}, "'hidden' = 0"),
        ({"hidden": [1 << 30]}, "'hidden'"),
        ({"hidden": [8] * 65}, "65 layers, at most 64"),
        ({"observation_dim": 1 << 50}, "'observation_dim'"),
        ({"states": 1 << 50}, "'states'"),
    ],
)
def test_a_policy_that_cannot_be(fields: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        admission.check_policy(replace(policy(1), architecture=replace(policy(1).architecture, **fields)))


def test_a_version_that_nobody_reaches_is_none() -> None:
    """It would make every later one a version of the past."""
    with pytest.raises(ValueError, match="'version' = 4611686018427387904"):
        admission.check_policy(policy(1 << 62))


@pytest.mark.parametrize("fields", [{"at_ns": 1 << 63}, {"start_unit": 1 << 41}, {"hold_units": 1 << 41}])
def test_a_phase_that_cannot_be(fields: dict[str, Any]) -> None:
    admission.check_notice(replace(window(), hold_units=None))
    with pytest.raises(ValueError, match="must be within"):
        admission.check_notice(replace(window(), **fields))
    with pytest.raises(ValueError, match="must be within"):
        channels.STATS.check(replace(stats("learner"), windows=[replace(window(), **fields)]))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"process": "learner.x"}, "process = 'learner.x': is none of ours"),
        ({"process": "learner.3"}, r"process = 'learner\.3': is none of ours"),
        ({"process": "env_server.16"}, r"process = 'env_server\.16': is none of ours"),
        ({"process": "agent_service.٣"}, "is none of ours"),
        ({"process": "env_server."}, r"process = 'env_server\.': is none of ours"),
        ({"process": "nobody"}, "process = 'nobody': is none of ours"),
        ({"process": "x" * 300}, r"process = 'x{79}\.\.\.: is none of ours"),
        ({"counters": {str(number): 1 for number in range(513)}}, "513 names: at most 512"),
        ({"gauges": {"x" * 257: 1.0}}, "a name of 257 characters"),
        ({"counters": {"ticks": -1}}, "'ticks' = -1"),
        ({"counters": {"ticks": 1 << 63}}, "'ticks' ="),
        ({"histograms": {"loop": b"\x90"}}, "histogram: "),
        ({"events": [Event(at_ns=1, level="INFO", text="")] * 513}, "513 events: at most 512"),
        ({"events": [Event(at_ns=1, level="INFO", text="x" * 1001)]}, "more than 1000 characters"),
    ],
)
def test_a_ledger_that_cannot_be(fields: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        channels.STATS.check(replace(stats("learner"), **fields))


def test_a_process_of_a_fleet_speaks_under_its_own_name() -> None:
    for process in ("env_server.0", "agent_service.15", "launcher"):
        channels.STATS.check(stats(process))


def test_a_ledger_may_have_what_a_diverging_learner_has() -> None:
    returns = [EpisodeReturn(episode=0, at_ns=1, value=-1e300, length=3)] * 20_000
    channels.STATS.check(replace(stats("learner"), gauges={"loss/critic": NAN}, returns=returns))


def test_an_order_has_what_belongs_to_it() -> None:
    for right in (Command(id="1", verb="schedule", schedule=ScheduleConfig()), Command(id="1", verb="hold")):
        admission.check_command(right)
    with pytest.raises(ValueError, match="verb = hold: it takes no schedule"):
        admission.check_command(Command(id="1", verb="hold", schedule=ScheduleConfig()))
    with pytest.raises(ValueError, match="a name of 300 characters"):
        admission.check_command(Command(id="i" * 300, verb="hold"))
