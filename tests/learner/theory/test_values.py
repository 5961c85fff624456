"""Exact values against numbers by hand, brute force over policies and Bellman's equations."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from learner.tabular.table import log_normalised
from learner.theory import values
from rtcore.config import ConfigError

# action 0 stays, action 1 goes to the other state; state 1 pays 1 for staying
REWARD = np.array([[0.0, 0.0], [1.0, 0.0]])
MOVES = np.array([[[1.0, 0], [0, 1]], [[0, 1], [1, 0]]])


def _random(rng: np.random.Generator, states: int = 4, actions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    return rng.normal(size=(states, actions)), rng.dirichlet([0.4] * states, size=(states, actions))


def test_two_states_by_hand() -> None:
    # V*(1) = 1 / (1 - 0.5) = 2, V*(0) = 0 + 0.5 * 2 = 1; Q*(0, stay) = 0.5 * 1, Q*(1, go) = 0.5 * 1
    found = values.optimal(REWARD, MOVES, gamma=0.5)
    np.testing.assert_allclose(found.q, [[0.5, 1.0], [2.0, 0.5]])
    np.testing.assert_allclose(found.v, [1.0, 2.0])
    # half and half: V(0) = 0.25 (V(0) + V(1)), V(1) = 0.5 + 0.25 (V(0) + V(1)), so their sum is 1
    even = values.evaluate(REWARD, MOVES, np.full((2, 2), 0.5), gamma=0.5)
    np.testing.assert_allclose(even.v, [0.25, 0.75])


def test_two_states_by_hand_for_two_steps() -> None:
    # the last step: V = (0, 1); the first: Q(0, .) = (0, 0.5), Q(1, .) = (1.5, 0)
    found = values.optimal(REWARD, MOVES, gamma=0.5, horizon=2)
    np.testing.assert_allclose(found.q, [[0.0, 0.5], [1.5, 0.0]])
    # half and half: last (0, 0.5); first V(0) = 0.5 * 0.25, V(1) = 0.5 + 0.5 * 0.25
    even = values.evaluate(REWARD, MOVES, np.full((2, 2), 0.5), gamma=0.5, horizon=2)
    np.testing.assert_allclose(even.v, [0.125, 0.625])


@pytest.mark.parametrize("seed", range(5))
def test_policy_iteration_finds_the_best_of_all_policies(seed: int) -> None:
    reward, moves = _random(np.random.default_rng(seed))
    every = [
        values.evaluate(reward, moves, np.eye(3)[list(choice)], gamma=0.9).v
        for choice in itertools.product(range(3), repeat=4)
    ]
    found = values.optimal(reward, moves, gamma=0.9)
    np.testing.assert_allclose(found.v, np.max(every, axis=0))
    np.testing.assert_allclose(found.q, reward + 0.9 * moves @ found.q.max(-1))


def test_a_finite_episode_may_change_its_policy_from_step_to_step() -> None:
    reward, moves = _random(np.random.default_rng(3), states=2, actions=2)
    returns = []
    for plan in itertools.product(itertools.product(range(2), repeat=2), repeat=3):  # 4 policies in 3 steps
        at, total = np.eye(2), np.zeros(2)
        for step, choice in enumerate(plan):
            total += 0.7**step * at @ reward[range(2), choice]
            at = at @ moves[range(2), choice]
        returns.append(total)
    found = values.optimal(reward, moves, gamma=0.7, horizon=3)
    np.testing.assert_allclose(found.v, np.max(returns, axis=0))


def test_a_policy_s_value_is_the_sum_along_its_way() -> None:
    rng = np.random.default_rng(4)
    reward, moves = _random(rng)
    policy = rng.dirichlet([1.0] * 3, size=4)
    at, total = np.eye(4), np.zeros(4)
    for step in range(400):
        total += 0.9**step * at @ (policy * reward).sum(-1)
        at = at @ np.einsum("sa,sat->st", policy, moves)
        if step == 9:
            ten = values.evaluate(reward, moves, policy, gamma=0.9, horizon=10)
            np.testing.assert_allclose(ten.v, total)
    found = values.evaluate(reward, moves, policy, gamma=0.9)
    np.testing.assert_allclose(found.v, total)
    np.testing.assert_allclose((policy * found.q).sum(-1), found.v)


def test_units_are_evaluated_at_once_as_one_by_one() -> None:
    rng = np.random.default_rng(5)
    worlds = [_random(rng) for _ in range(6)]
    reward, moves = (np.stack(arrays) for arrays in zip(*worlds, strict=True))
    for horizon in (None, 5):
        together = values.optimal(reward, moves, gamma=0.9, horizon=horizon)
        alone = [values.optimal(r, p, gamma=0.9, horizon=horizon).q for r, p in worlds]
        np.testing.assert_allclose(together.q, alone)


def test_a_softened_bandit_by_hand() -> None:
    # V*_tau = tau log(e^{1/tau} + e^0) and pi*_tau(0) / pi*_tau(1) = e^{1/tau}, at tau = 1/2
    found = values.soft_optimal(np.array([[1.0, 0.0]]), np.ones((1, 2, 1)), gamma=0.0, tau=0.5)
    assert found.v == pytest.approx([0.5 * np.log(np.exp(2) + 1)])
    assert found.log_policy[0, 0] - found.log_policy[0, 1] == pytest.approx(2.0)
    # of the even policy: 1/2 + tau log 2
    even = values.soft_evaluate(
        np.array([[1.0, 0.0]]), np.ones((1, 2, 1)), np.log([[0.5, 0.5]]), gamma=0.0, tau=0.5
    )
    assert even.v == pytest.approx([0.5 + 0.5 * np.log(2)])


@pytest.mark.parametrize("gamma", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("tau", [0.001, 0.1, 10.0])
def test_the_softened_optimum_solves_its_equation_and_beats_others(gamma: float, tau: float) -> None:
    rng = np.random.default_rng(6)
    reward, moves = _random(rng)
    found = values.soft_optimal(reward, moves, gamma=gamma, tau=tau)
    peak = found.q.max(-1)
    soft_max = peak + tau * np.log(np.exp((found.q - peak[:, None]) / tau).sum(-1))
    np.testing.assert_allclose(found.v, soft_max, rtol=1e-9)
    np.testing.assert_allclose(found.q, reward + gamma * moves @ found.v, rtol=1e-9)
    np.testing.assert_allclose(found.log_policy, log_normalised(found.q / tau), atol=1e-6)
    for _ in range(20):
        other = log_normalised(rng.normal(size=(4, 3)) * 10 ** rng.uniform(-1, 2))
        assert (values.soft_evaluate(reward, moves, other, gamma=gamma, tau=tau).v <= found.v + 1e-9).all()
    plain = values.optimal(reward, moves, gamma=gamma).v
    assert (found.v >= plain - 1e-9).all()
    assert (found.v <= plain + tau * np.log(3) / (1 - gamma) + 1e-9).all()


def test_equally_good_actions_do_not_go_round_in_circles() -> None:
    found = values.optimal(np.full((3, 4), 0.1), np.full((3, 4, 3), 1 / 3), gamma=0.99)
    np.testing.assert_allclose(found.v, 10.0)


@pytest.mark.parametrize(
    ("gamma", "tau", "named"), [(1.0, 0.1, "gamma"), (0.9, 0.0, "tau"), (-0.1, 1, "gamma")]
)
def test_what_has_no_value_is_refused(gamma: float, tau: float, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        values.soft_optimal(REWARD, MOVES, gamma=gamma, tau=tau)
    if named == "gamma":
        with pytest.raises(ConfigError, match="gamma"):
            values.optimal(REWARD, MOVES, gamma=gamma)


STAY = np.full((2, 2), 0.5)


@pytest.mark.parametrize(
    ("reward", "moves", "said"),
    [
        (REWARD, 2 * MOVES, r"transition\[0, 0\] = \[2.0, 0.0\]: must be >= 0 and sum to 1"),
        (REWARD, MOVES - [[[0.5, -0.5]]], r"transition\[0, 1\] = \[-0.5, 1.5\]: must be >= 0"),
        (REWARD, MOVES * np.nan, r"transition\[0, 0\] = \[nan, nan\]: must be >= 0"),
        (REWARD, MOVES[:1], r"transition.shape = \(1, 2, 2\): must end with \[S, A, S\] = \(2, 2, 2\)"),
        (REWARD[0], MOVES, r"reward.shape = \(2,\): must be \[..., S, A\]"),
        (REWARD[:0], MOVES, r"reward.shape = \(0, 2\): must be"),
        (REWARD + np.inf, MOVES, r"reward\[0, 0\] = inf: must be finite"),
    ],
)
def test_what_is_no_mdp_is_refused(reward: np.ndarray, moves: np.ndarray, said: str) -> None:
    for horizon in (None, 3):
        with pytest.raises(ConfigError, match=said):
            values.optimal(reward, moves, gamma=0.9, horizon=horizon)
        with pytest.raises(ConfigError, match=said):
            values.evaluate(reward, moves, STAY, gamma=0.9, horizon=horizon)
    with pytest.raises(ConfigError, match=said):
        values.soft_optimal(reward, moves, gamma=0.9, tau=0.1)
    with pytest.raises(ConfigError, match=said):
        values.soft_evaluate(reward, moves, np.log(STAY), gamma=0.9, tau=0.1)


def test_a_policy_of_another_world_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"policy.shape = \(3, 2\): must end with \[S, A\] = \(2, 2\)"):
        values.evaluate(REWARD, MOVES, np.full((3, 2), 0.5), gamma=0.5)
    with pytest.raises(ConfigError, match=r"log_policy\[0, 1\] = -inf: must be finite"):
        values.soft_evaluate(REWARD, MOVES, np.array([[0.0, -np.inf], [0, 0]]), gamma=0.5, tau=0.1)
