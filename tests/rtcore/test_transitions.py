from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from rtcore.messages import Step
from rtcore.stream import Transition, Transitions
from tests.rtcore.steps import floats, make_step


def one(transitions: Transitions, step: Step) -> Transition:
    transition = transitions.feed(step)
    assert transition is not None
    return transition


def test_a_transition_by_hand() -> None:
    transitions = Transitions(observation_dim=2, action_dim=1)
    assert transitions.feed(make_step(5)) is None  # the reset of episode 1
    made = one(transitions, make_step(6))
    assert made.obs.tolist() == [5, 1] and made.next_obs.tolist() == [6, 1]
    assert made.decision.tolist() == [-6]  # what entered the delay line, not the action -1006 that acted
    assert (made.reward, made.unit, made.tick, made.incarnation, made.seq) == (3.0, 2, 106, 1, 6)
    assert not made.terminated and not made.truncated
    assert made.obs.dtype == made.next_obs.dtype == made.decision.dtype == np.float32
    assert one(transitions, make_step(7)).obs.tolist() == [6, 1]


def test_terminated_and_truncated_stay_apart() -> None:
    for terminated, truncated in ((True, False), (False, True), (True, True)):
        transitions = Transitions()
        transitions.feed(make_step(0))
        made = one(transitions, make_step(1, terminated=terminated, truncated=truncated))
        assert (made.terminated, made.truncated) == (terminated, truncated)


def tally(transitions: Transitions) -> tuple[int, int, int, int]:
    return transitions.transitions, transitions.resets, transitions.broken, transitions.invalid


def test_whole_episodes() -> None:
    transitions = Transitions()
    ended_in = [step for seq in range(10) if transitions.feed(step := make_step(seq)) is not None]
    assert [step.seq for step in ended_in] == [1, 2, 3, 4, 6, 7, 8, 9]
    assert tally(transitions) == (8, 2, 0, 0)


@pytest.mark.parametrize(
    "step",
    [
        make_step(3),  # a gap
        make_step(3, episode_tick=2),
        make_step(2, incarnation=2),  # another life of the env server
        make_step(2, episode=1),  # another episode, whose reset never came
        make_step(2, episode_tick=3),
        make_step(2, observation=floats(1, 2, 3)),
        make_step(1),  # the same again
    ],
)
def test_a_step_without_its_predecessor_ends_no_transition(step: Step) -> None:
    transitions = Transitions()
    transitions.feed(make_step(0))
    transitions.feed(make_step(1))
    assert transitions.feed(step) is None
    assert tally(transitions) == (1, 1, 1, 0)


def test_after_a_gap_the_next_pair_is_whole_again() -> None:
    transitions = Transitions()
    assert transitions.feed(make_step(2)) is None
    assert one(transitions, make_step(3)).obs.tolist() == [2, 1]
    assert tally(transitions) == (1, 0, 1, 0)


def test_nothing_follows_the_end_of_an_episode_but_a_reset() -> None:
    for end in ("terminated", "truncated"):
        transitions = Transitions()
        transitions.feed(make_step(0, **{end: True}))
        assert transitions.feed(make_step(1)) is None
        assert tally(transitions) == (0, 1, 1, 0)


@pytest.mark.parametrize(
    "fields",
    [
        {"reward": float("nan")},
        {"reward": float("-inf")},
        {"observation": floats(float("nan"), 0)},
        {"observation": floats(1)},
        {"observation": b""},
        {"observation": b"12345"},
        {"decision": floats(float("inf"))},
        {"decision": floats(1, 2)},
        {"decision": b""},
    ],
)
def test_bad_numbers_reach_no_transition(fields: dict[str, Any]) -> None:
    transitions = Transitions(observation_dim=2, action_dim=1)
    transitions.feed(make_step(0))
    assert transitions.feed(make_step(1, **fields)) is None
    assert transitions.previous is None
    assert transitions.feed(make_step(2)) is None  # nor may the bad step begin one
    assert one(transitions, make_step(3)).obs.tolist() == [2, 1]
    assert tally(transitions) == (1, 1, 1, 1)


def test_a_restarted_reader_keeps_the_transition_across() -> None:
    before = Transitions()
    before.feed(make_step(0))
    before.feed(make_step(1))
    saved = msgspec.msgpack.encode(before.previous)
    after = Transitions(previous=msgspec.msgpack.decode(saved, type=Step))
    assert one(after, make_step(2)).obs.tolist() == [1, 1]


def test_arrays_are_read_only() -> None:
    transitions = Transitions()
    transitions.feed(make_step(0))
    made = one(transitions, make_step(1))
    assert not (made.obs.flags.writeable or made.next_obs.flags.writeable or made.decision.flags.writeable)
