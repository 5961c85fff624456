"""The equations on tables, against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from learner.tabular.table import epsilon_greedy, greedy, log_normalised, mix, npg_step, q_update

ONE = {
    "state": np.array([0]),
    "action": np.array([1]),
    "reward": np.array([1.0]),
    "next_state": np.array([1]),
}


def test_a_transition_moves_its_entry_alone() -> None:
    q = np.array([[[1.0, 2.0], [3.0, 5.0]]])
    # delta = 1 + 0.9 * max(3, 5) - 2 = 3.5, and 2 + 0.5 * 3.5 = 3.75
    delta = q_update(q, **ONE, terminated=np.array([False]), step_size=0.5, gamma=0.9)
    assert delta == pytest.approx([3.5])
    np.testing.assert_allclose(q, [[[1.0, 3.75], [3.0, 5.0]]])


def test_nothing_follows_the_end() -> None:
    q = np.array([[[1.0, 2.0], [3.0, 5.0]]])
    # delta = 1 - 2 = -1, and 2 - 0.5 = 1.5
    assert q_update(q, **ONE, terminated=np.array([True]), step_size=0.5, gamma=0.9) == pytest.approx([-1.0])
    assert q[0, 0, 1] == pytest.approx(1.5)


def test_a_transition_to_its_own_state_takes_the_table_as_it_was() -> None:
    q = np.array([[[4.0, 2.0]]])
    # delta = 1 + 0.5 * 4 - 4 = -1, and 4 - 0.25 = 3.75
    stays = {"state": np.array([0]), "action": np.array([0]), "next_state": np.array([0])}
    q_update(q, reward=np.array([1.0]), terminated=np.array([False]), step_size=0.25, gamma=0.5, **stays)
    np.testing.assert_allclose(q, [[[3.75, 2.0]]])


def test_lanes_do_not_see_each_other() -> None:
    q = np.zeros((2, 2, 2))
    q[1, 1] = [0.0, 10.0]
    delta = q_update(
        q,
        state=np.array([0, 0]),
        action=np.array([0, 1]),
        reward=np.array([1.0, 2.0]),
        next_state=np.array([1, 1]),
        terminated=np.array([False, False]),
        step_size=np.array([0.5, 0.1]),
        gamma=0.5,
    )
    assert delta == pytest.approx([1.0, 7.0])  # 1 + 0.5 * 0, and 2 + 0.5 * 10
    np.testing.assert_allclose(q[0], [[0.5, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(q[1], [[0.0, 0.7], [0.0, 10.0]])


def test_the_first_of_equals_is_greedy() -> None:
    assert greedy(np.array([[1.0, 3.0, 3.0], [2.0, 2.0, 2.0]])).tolist() == [1, 0]


def test_epsilon_greedy_by_hand() -> None:
    # four actions: 0.2 / 4 = 0.05 each, and 0.8 more on the greedy one
    found = epsilon_greedy(np.array([[0.0, 7.0, 1.0, 7.0]]), 0.2)
    np.testing.assert_allclose(found, [[0.05, 0.85, 0.05, 0.05]])


def test_mix_by_hand() -> None:
    # half of (0.9, 0.1), and 0.25 each
    np.testing.assert_allclose(mix(np.array([[0.9, 0.1]]), 0.5), [[0.7, 0.3]])


def test_one_step_of_the_natural_policy_gradient_by_hand() -> None:
    # gamma = 0.5, tau = 1, eta = 0.25: pi^(1 - 0.25/0.5) exp(0.25 Q / 0.5) = sqrt(pi) exp(Q / 2)
    # state 0: sqrt(0.8) * 1 against sqrt(0.2) * 2 = sqrt(0.8): even
    # state 1: sqrt(0.8) * 3 against sqrt(0.2) * 1: 6 to 1
    log_policy = np.log([[0.8, 0.2], [0.8, 0.2]])
    q = np.array([[0.0, 2 * np.log(2)], [2 * np.log(3), 0.0]])
    found = np.exp(npg_step(log_policy, q, eta=0.25, entropy=1.0, gamma=0.5))
    np.testing.assert_allclose(found, [[0.5, 0.5], [6 / 7, 1 / 7]], rtol=1e-14)


def test_many_steps_towards_one_q_have_a_closed_form() -> None:
    # log pi_g = beta^g log pi_0 + (1 - beta^g) Q / tau - log Z, beta = 1 - eta tau / (1 - gamma):
    # a step is log pi -> beta log pi + (1 - beta) Q / tau, and eta / (1 - gamma) = (1 - beta) / tau
    rng = np.random.default_rng(3)
    first, q = log_normalised(rng.standard_normal((2, 3, 4))), rng.standard_normal((2, 3, 4))
    eta, tau, gamma, steps = 0.2, 0.1, 0.9, 7
    beta = 1 - eta * tau / (1 - gamma)
    assert beta == pytest.approx(0.8)
    log_policy = first
    for _ in range(steps):
        log_policy = npg_step(log_policy, q, eta=eta, entropy=tau, gamma=gamma)
    kept = beta**steps
    expected = np.exp(kept * first + (1 - kept) / tau * q)
    expected /= expected.sum(-1, keepdims=True)
    np.testing.assert_allclose(np.exp(log_policy), expected, rtol=1e-12)


def test_the_largest_step_goes_all_the_way() -> None:
    # eta = (1 - gamma) / tau: what was is forgotten, and pi = softmax(Q / tau) at once: exp(ln 3) to 1
    q = np.array([[0.1 * np.log(3), 0.0]])
    found = np.exp(npg_step(np.log([[0.01, 0.99]]), q, eta=(1 - 0.9) / 0.1, entropy=0.1, gamma=0.9))
    np.testing.assert_allclose(found, [[0.75, 0.25]], rtol=1e-12)


@pytest.mark.parametrize(("eta", "gamma"), [(1.01, 0.9), (0.0, 0.9), (0.1, 1.0)])
def test_a_step_too_far_is_refused(eta: float, gamma: float) -> None:
    with pytest.raises(AssertionError, match="must be in"):
        npg_step(np.zeros((1, 2)), np.zeros((1, 2)), eta=eta, entropy=0.1, gamma=gamma)


def test_large_values_stay_finite() -> None:
    found = npg_step(np.log([[0.5, 0.5]]), np.array([[1e6, -1e6]]), eta=0.1, entropy=0.1, gamma=0.9)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(np.exp(found), [[1.0, 0.0]])
