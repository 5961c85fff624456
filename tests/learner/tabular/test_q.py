"""Reactive Q-learning from the replay: every transition once, in order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from learner.replay import Replay
from learner.tabular.q import QLearning
from tests.learner.tabular.lived import TWO_STATES, live, table_config


def learner(replay: Replay, **table: float) -> QLearning:
    fields: dict[str, Any] = {"step_size": 0.5} | table
    return QLearning(table_config("q", gamma=1.0, **fields), TWO_STATES, 0, replay)


def q_of(found: QLearning) -> list[list[float]]:
    return found.state().tensors["q"].tolist()  # type: ignore[no-any-return]


def test_it_learns_in_order_and_each_transition_once() -> None:
    replay = Replay(10, 1, 1)
    found = learner(replay)
    live(replay, 0, 0, 1.0, after=1)
    live(replay, 1, 0, 2.0, ends=True)
    found.update(improve_policy=True)
    # Q(0,0) = 0.5 * (1 + 0), then Q(1,0) = 0.5 * 2; the other way round Q(0,0) would be 1
    assert q_of(found) == [[0.5, 0.0], [1.0, 0.0]]
    found.update(improve_policy=True)
    assert q_of(found) == [[0.5, 0.0], [1.0, 0.0]]
    live(replay, 0, 0, 1.0, after=1)
    found.update(improve_policy=True)
    # Q(0,0) = 0.5 + 0.5 * (1 + 1 - 0.5)
    assert q_of(found) == [[1.25, 0.0], [1.0, 0.0]]
    assert (found.gradient_steps, found.policy_steps) == (3, 3)
    assert found.metrics()["loss/td_error"] == pytest.approx(1.5)


def test_what_the_ring_overwrote_is_counted() -> None:
    replay = Replay(3, 1, 1)
    found = learner(replay)
    live(replay, 1, 1, 8.0, ends=True)
    found.update(improve_policy=True)
    for reward in (100.0, 100.0, 2.0, 4.0, 6.0):  # the ring holds the last three
        live(replay, 0, 1, reward, ends=True)
    found.update(improve_policy=True)
    # 0.5 * 2 = 1; 1 + 0.5 * 3 = 2.5; 2.5 + 0.5 * 3.5 = 4.25
    assert q_of(found) == [[0.0, 4.25], [0.0, 4.0]]
    assert found.gradient_steps == 4
    assert found.metrics()["table/unread"] == 2
    found.update(improve_policy=True)
    assert found.gradient_steps == 4
    assert found.metrics()["table/unread"] == 2


def test_a_long_queue_is_learned_in_several_calls() -> None:
    replay = Replay(5000, 1, 1)
    for _ in range(2500):
        live(replay, 0, 0, 1.0, ends=True)
    found = learner(replay, step_size=0.001)
    made: list[int] = []
    while not made or made[-1]:
        before = found.gradient_steps
        found.update(improve_policy=True)
        made.append(found.gradient_steps - before)
    assert made == [1000, 1000, 500, 0]
    assert q_of(found)[0][0] == pytest.approx(1 - 0.999**2500)


def test_numbers_of_nothing_are_counted_and_not_learned() -> None:
    replay = Replay(10, 1, 1)
    found = learner(replay)
    for state, action, after in ((2, 0, 0), (-1, 0, 0), (0, 0.5, 0), (0, 2, 0), (0, 0, 1e30)):
        live(replay, state, action, 1.0, after=after)
    live(replay, 1, 1, 1.0, ends=True)
    found.update(improve_policy=True)
    assert q_of(found) == [[0.0, 0.0], [0.0, 0.5]]
    assert found.gradient_steps == 1
    assert found.metrics()["table/invalid"] == 5


def test_the_policy_is_epsilon_greedy_of_q_as_it_is() -> None:
    replay = Replay(10, 1, 1)
    found = learner(replay, epsilon=0.2)
    live(replay, 0, 1, 1.0, ends=True)
    found.update(improve_policy=True)
    probability = found.policy_arrays()["probability"]
    assert probability.dtype == np.float32
    # nothing known in state 1: the first action is greedy
    np.testing.assert_allclose(probability, [[0.1, 0.9], [0.9, 0.1]], rtol=1e-6)


def test_in_a_hold_q_is_learned_and_the_next_iterate_has_it() -> None:
    replay = Replay(10, 1, 1)
    found = learner(replay)
    assert not found.iterate(1)
    live(replay, 0, 1, 1.0, ends=True)
    found.update(improve_policy=False)
    assert (found.gradient_steps, found.policy_steps) == (1, 0)
    assert q_of(found)[0] == [0.0, 0.5]
    assert found.iterate(1)
    assert not found.iterate(1)


def test_metrics_by_hand() -> None:
    replay = Replay(10, 1, 1)
    found = learner(replay, epsilon=1.0, initial=7.0)
    assert found.metrics()["q_mean"] == 7.0
    live(replay, 0, 1, 1.0, ends=True)  # 7 + 0.5 * (1 - 7) = 4
    live(replay, 1, 1, 5.0, ends=True)  # 7 + 0.5 * (5 - 7) = 6
    found.update(improve_policy=True)
    metrics = found.metrics()
    assert metrics["loss/td_error"] == pytest.approx(4.0)  # of 6 and 2
    assert metrics["q_mean"] == pytest.approx(5.0)
    assert metrics["table/visited"] == 0.5
    assert metrics["entropy"] == pytest.approx(np.log(2))  # two actions, uniform


def test_a_certain_policy_has_no_entropy() -> None:
    assert learner(Replay(1, 1, 1), epsilon=0.0).metrics()["entropy"] == 0.0
