"""What acts at a deadline, case by case."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from env_server.actuation import Actuation, Decision, Rules
from rtcore.config import MissPolicy
from rtcore.messages import Action

INCARNATION = 77


def make(
    *,
    on_miss: MissPolicy = "hold",
    hold_ticks: int = 2,
    delay: int = 0,
    observe: int = 0,
    low: Sequence[float] = (-1.0, -2.0),
    high: Sequence[float] = (1.0, 2.0),
    actions: int = 0,
) -> Actuation:
    return Actuation(
        Rules(
            on_miss=on_miss,
            hold_ticks=hold_ticks,
            action_delay_ticks=delay,
            observe_actions=observe,
            low=np.array(low, np.float32),
            high=np.array(high, np.float32),
            actions=actions,
            incarnation=INCARNATION,
        )
    )


def action(
    tick: int,
    values: Sequence[float] | bytes = (0.5, 1.0),
    *,
    version: int = 3,
    incarnation: int = INCARNATION,
) -> Action:
    data = values if isinstance(values, bytes) else np.array(values, np.float32).tobytes()
    return Action(
        env="env0", incarnation=incarnation, tick=tick, values=data, policy_version=version, received_ns=1,
        sent_ns=2,
    )  # fmt: skip


def decide(actuation: Actuation, newest: Action | None, expected: int = 9) -> Decision:
    return actuation.decide(newest, expected_tick=expected)


def test_an_answer_in_time_acts_at_once() -> None:
    decision = decide(make(), action(9, (0.5, -1.5), version=4))
    assert decision.applied.tolist() == decision.decided.tolist() == [0.5, -1.5]
    assert decision.applied.dtype == np.float32
    assert (decision.missed, decision.fallback) == (False, "")
    assert (decision.policy_version, decision.answered_tick) == (4, 9)
    assert (decision.verdict, decision.clipped) == ("answer", False)


def test_a_miss_holds_the_last_answer_and_says_whose_it_is() -> None:
    actuation = make()
    decide(actuation, action(9, (0.5, -1.5), version=4))
    for expected in (10, 11, 12):
        decision = decide(actuation, None, expected)
        assert decision.applied.tolist() == [0.5, -1.5]
        assert (decision.missed, decision.fallback) == (True, "hold")
        assert (decision.policy_version, decision.answered_tick, decision.verdict) == (4, 9, "none")


def test_there_is_nothing_to_hold_before_the_first_answer_of_an_episode() -> None:
    actuation = make()
    assert decide(actuation, None).fallback == "neutral"
    decide(actuation, action(9))
    assert decide(actuation, None, 10).fallback == "hold"
    assert actuation.reset(None) == "none"
    decision = decide(actuation, None, 12)
    assert (decision.fallback, decision.applied.tolist()) == ("neutral", [0.0, 0.0])
    assert (decision.policy_version, decision.answered_tick) == (-1, -1)


def test_neutral_on_a_miss() -> None:
    actuation = make(on_miss="neutral")
    decide(actuation, action(9))
    decision = decide(actuation, None, 10)
    assert (decision.fallback, decision.applied.tolist()) == ("neutral", [0.0, 0.0])
    assert (decision.policy_version, decision.answered_tick) == (-1, -1)


def test_neutral_is_zero_within_the_bounds() -> None:
    actuation = make(on_miss="neutral", low=(0.25, -2.0), high=(1.0, -0.5))
    assert decide(actuation, None).applied.tolist() == [0.25, -0.5]


@pytest.mark.parametrize(
    ("hold_ticks", "fallbacks"),
    [(0, ["neutral"] * 4), (1, ["hold", "neutral", "neutral", "neutral"]), (3, ["hold"] * 3 + ["neutral"])],
)
def test_hold_then_neutral(hold_ticks: int, fallbacks: list[str]) -> None:
    actuation = make(on_miss="hold_then_neutral", hold_ticks=hold_ticks)
    for begin in (9, 20):  # an answer in between starts the count again
        decide(actuation, action(begin), begin)
        assert [decide(actuation, None, begin + 1 + k).fallback for k in range(4)] == fallbacks


@pytest.mark.parametrize(
    ("newest", "verdict"),
    [
        (action(8), "stale"),
        (action(0), "stale"),
        (action(9, incarnation=76), "stale"),
        (action(10), "invalid"),  # an answer to what was not asked yet
        (action(9, (math.nan, 0.0)), "invalid"),
        (action(9, (0.0, -math.inf)), "invalid"),
        (action(9, (0.5,)), "invalid"),
        (action(9, (0.5, 0.5, 0.5)), "invalid"),
        (action(9, b""), "invalid"),
        (action(9, b"12345"), "invalid"),
    ],
)
def test_what_is_no_answer_does_not_act(newest: Action, verdict: str) -> None:
    actuation = make()
    decide(actuation, action(8, (0.125, 0.25), version=2), 8)
    decision = decide(actuation, newest)
    assert decision.verdict == verdict
    assert (decision.missed, decision.fallback) == (True, "hold")
    assert decision.applied.tolist() == [0.125, 0.25]
    assert (decision.policy_version, decision.answered_tick) == (2, 8)


def test_out_of_bounds_is_clipped_and_told() -> None:
    decision = decide(make(), action(9, (1.5, -1e30)))
    assert decision.applied.tolist() == [1.0, -2.0]
    assert (decision.verdict, decision.clipped, decision.missed) == ("answer", True, False)
    rounding = decide(make(), action(9, (1.0 + 2e-7, 0.0)))
    assert (rounding.applied.tolist(), rounding.clipped) == ([1.0, 0.0], False)


def finite(*, on_miss: MissPolicy = "hold", delay: int = 0) -> Actuation:
    """Four actions, 0 to 3."""
    return make(on_miss=on_miss, delay=delay, low=(0.0,), high=(3.0,), actions=4)


@pytest.mark.parametrize("number", [0.0, 1.0, 3.0])
def test_a_finite_world_takes_the_number_of_an_action(number: float) -> None:
    decision = decide(finite(), action(9, (number,)))
    assert (decision.applied.tolist(), decision.verdict) == ([number], "answer")
    assert (decision.missed, decision.clipped) == (False, False)


@pytest.mark.parametrize("number", [-1.0, 4.0, 1.5, 2.999, -0.25, 1e30, math.nan, math.inf, -math.inf])
def test_what_is_no_number_of_an_action_is_no_answer(number: float) -> None:
    actuation = finite()
    decide(actuation, action(8, (2.0,)), 8)
    decision = decide(actuation, action(9, (number,)))
    assert (decision.verdict, decision.missed, decision.fallback) == ("invalid", True, "hold")
    assert (decision.applied.tolist(), decision.clipped) == ([2.0], False)


def test_neutral_is_action_0_in_a_finite_world() -> None:
    actuation = finite(on_miss="neutral", delay=1)
    assert decide(actuation, action(1, (3.0,)), 1).applied.tolist() == [0.0]  # what the delay line began with
    assert decide(actuation, None, 2).applied.tolist() == [3.0]
    assert decide(actuation, action(3, (1.0,)), 3).applied.tolist() == [0.0]


@pytest.mark.parametrize(
    ("delay", "applied"),
    [(0, [1, 2, 3, 4, 5, 6]), (1, [0, 1, 2, 3, 4, 5]), (3, [0, 0, 0, 1, 2, 3])],
)
def test_delay_line(delay: int, applied: list[int]) -> None:
    actuation = make(delay=delay, low=(-9.0, -9.0), high=(9.0, 9.0))
    decisions = [decide(actuation, action(k, (k, -k)), k) for k in range(1, 7)]
    assert [decision.applied.tolist() for decision in decisions] == [[k, -k] for k in applied]
    assert [decision.decided.tolist() for decision in decisions] == [[k, -k] for k in range(1, 7)]


def test_a_reset_empties_the_delay_line() -> None:
    actuation = make(delay=1)
    decide(actuation, action(1, (0.5, 0.5)), 1)
    actuation.reset(action(2))
    assert decide(actuation, action(3, (0.25, 0.25)), 3).applied.tolist() == [0.0, 0.0]
    assert decide(actuation, action(4), 4).applied.tolist() == [0.25, 0.25]


def test_a_held_action_goes_through_the_delay_line_too() -> None:
    actuation = make(delay=1)
    decide(actuation, action(1, (0.5, 0.5)), 1)
    decide(actuation, None, 2)
    assert decide(actuation, action(3, (0.75, 0.75)), 3).applied.tolist() == [0.5, 0.5]
    assert decide(actuation, action(4), 4).applied.tolist() == [0.75, 0.75]


def test_observed_actions_newest_first() -> None:
    actuation = make(observe=2)
    own = np.array([7.0], np.float32)
    assert actuation.observed(own).tolist() == [7, 0, 0, 0, 0]
    decide(actuation, action(1, (0.5, 1.0)), 1)
    assert actuation.observed(own).tolist() == [7, 0.5, 1.0, 0, 0]
    decide(actuation, action(2, (0.25, -1.0)), 2)
    assert actuation.observed(own).tolist() == [7, 0.25, -1.0, 0.5, 1.0]
    decide(actuation, None, 3)
    assert actuation.observed(own).tolist() == [7, 0.25, -1.0, 0.25, -1.0]
    assert actuation.observed(own).dtype == np.float32
    actuation.reset(None)
    assert actuation.observed(own).tolist() == [7, 0, 0, 0, 0]


def test_observed_actions_are_the_decisions_not_yet_applied() -> None:
    actuation = make(observe=1, delay=2)
    decision = decide(actuation, action(1, (0.5, 1.0)), 1)
    assert decision.applied.tolist() == [0, 0]
    assert actuation.observed(np.empty(0, np.float32)).tolist() == [0.5, 1.0]


def test_observed_actions_are_neutral_at_a_reset() -> None:
    actuation = make(observe=1, low=(0.25, -2.0), high=(1.0, 2.0))
    assert actuation.observed(np.empty(0, np.float32)).tolist() == [0.25, 0.0]


def test_a_world_cannot_scribble_into_an_action_that_may_be_held() -> None:
    actuation = make()
    for newest in (None, action(2)):
        with pytest.raises(ValueError, match="read-only"):
            decide(actuation, newest, 2).applied[:] = 9.0
