"""The schedule `auto`'s rule: predicted regret, trust in slopes and the choice, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from learner.schedule.plan import Floats, advantage_change, choose, predicted_regret, slope_trust

WINDOW = 20


def _late_change() -> tuple[Floats, Floats]:
    """One state. Action 1 is better by 1 until k = 12, and worse by 0.9 after; pi^g(1) = g / 20."""
    k = np.arange(WINDOW + 1)
    q = np.zeros((WINDOW + 1, 1, 2))
    q[..., 0] = np.where(k <= 12, -1.0, 0.9)[:, None]
    return q, np.stack([1 - k / WINDOW, k / WINDOW], -1)[:, None]


def test_predicted_regret_by_hand() -> None:
    """A unit k <= 12 loses 1 - min(k, G) / 20, another 0.9 min(k, G) / 20. One more update saves 1 / 20 in
    12 - G units and costs 0.9 / 20 in 8: it pays while 12 - G > 7.2, so G = 5 is best.
    With it 13 - 50 / 20 + 0.9 x 8 x 5 / 20 = 12.3; with G = 20, 13 - 78 / 20 + 0.9 x 132 / 20 = 15.04.
    """
    predicted = predicted_regret(*_late_change())
    assert predicted.shape == (WINDOW,)
    assert choose(predicted) == 5
    np.testing.assert_allclose(predicted[[4, -1]], [12.3, 15.04])


def test_states_count_alike() -> None:
    """Another state, in which no action is better, halves the mean."""
    q, policy = _late_change()
    both = predicted_regret(np.concatenate([q, 0 * q], 1), np.concatenate([policy, policy[::-1]], 1))
    np.testing.assert_allclose(both, predicted_regret(q, policy) / 2)


def test_a_window_of_one_unit() -> None:
    """pi^0 loses 1 in unit 0 and pi^1 0.5 x 2 in unit 1."""
    q = np.array([[[0.0, -1.0]], [[2.0, 0.0]]])
    policy = np.array([[[0.0, 1.0]], [[0.5, 0.5]]])
    assert predicted_regret(q, policy).tolist() == [2.0]


# U(G) = 3, 2, 2, 5, 4: G = 2 saves half of what is predicted for W = 5.
PREDICTED = np.array([3.0, 2.0, 2.0, 5.0, 4.0])


@pytest.mark.parametrize(
    ("least_gain", "least_update", "update"),
    [
        (0.0, 1, 2),  # the smaller of equals
        (0.5, 1, 2),
        (0.51, 1, 5),
        (0.5, 3, 3),
        (0.0, 4, 5),  # 5 and 4 are left
        (0.0, 5, 5),
    ],
)
def test_a_hold_must_gain(least_gain: float, least_update: int, update: int) -> None:
    assert choose(PREDICTED, least_gain=least_gain, least_update=least_update) == update


def test_what_is_not_allowed_gains_nothing() -> None:
    """G = 1 would save three quarters, but of 2 and 3 only 2 saves anything: a quarter."""
    predicted = np.array([1.0, 3.0, 4.0])
    assert choose(predicted, least_gain=0.25, least_update=2) == 2
    assert choose(predicted, least_gain=0.26, least_update=2) == 3


def test_a_hold_must_be_trusted() -> None:
    trust = np.array([0.0, 0.6, 0.61, 1.0])
    lanes = np.repeat(PREDICTED[:, None], 4, 1)
    assert choose(lanes, trust, least_trust=0.6).tolist() == [5, 5, 2, 2]
    assert choose(lanes, trust, least_trust=0.6, least_gain=0.51).tolist() == [5, 5, 5, 5]
    assert choose(PREDICTED, np.array(0.5)) == 5  # half is not more than half
    assert choose(PREDICTED, np.array(0.51)) == 2


def test_no_regret_to_save_is_no_hold() -> None:
    """With least_gain 0 a gain of 0 would do, so the smallest G: but the product asks for some."""
    assert choose(np.full(5, 2.0)) == 5


def _tables(times: Floats) -> Floats:
    """Of two states and two actions: only Q(0, 1) has a slope, 2; all have the same residuals.

    (2, -3, 1) / 10 sums to 0, alone and against the times (0, 1, 3).
    """
    past = np.multiply.outer(np.array([2.0, -3.0, 1.0]) / 10, np.ones((2, 2))) + 7.0
    past[:, 0, 1] += 2.0 * times
    return past


def test_trust_by_hand() -> None:
    """Times 0, 1, 3: mean 4/3 and Sxx = (16 + 1 + 25) / 9 = 14/3. RSS = 14 / 100 each, and one degree of
    freedom: se^2 = 0.14 / (14/3) = 0.03. rho = 1 - 10 x 4 x 0.03 / (2 x 2) = 0.7.
    """
    times = np.array([0.0, 1.0, 3.0])
    past = _tables(times)
    assert slope_trust(past, times) == pytest.approx(0.7)
    assert slope_trust(past[::-1], times[::-1]) == pytest.approx(0.7)
    assert slope_trust(past, 60 * times - 1000) == pytest.approx(0.7)  # other units of time
    assert slope_trust(past, np.array([0.0, 1.0, 2.0])) != pytest.approx(0.7, abs=0.05)


def test_trust_is_in_0_to_1() -> None:
    times = np.arange(20.0)
    assert slope_trust(np.random.default_rng(0).normal(size=(20, 3, 2)), times) == 0.0
    line = np.multiply.outer(times, np.ones((3, 2)))
    assert slope_trust(line, times) == pytest.approx(1.0)


def test_nothing_known_is_not_trusted() -> None:
    line = np.multiply.outer(np.arange(3.0), np.ones((2, 2)))
    assert slope_trust(line[:2], np.arange(2.0)) == 0.0  # two tables are on a line whatever they are
    assert slope_trust(line, np.ones(3)) == 0.0  # at once
    assert slope_trust(np.ones((3, 2, 2)), np.arange(3.0)) == 0.0  # and nothing moves


def test_lanes_are_single_calls() -> None:
    rng = np.random.default_rng(1)
    q = rng.normal(size=(6, 2, 3, 4, 2))
    policy = rng.dirichlet(np.ones(2), (6, 2, 3, 4))
    past, times = rng.normal(size=(9, 2, 3, 4, 2)) + np.arange(9.0)[:, None, None, None, None], np.arange(9.0)
    predicted, trust = predicted_regret(q, policy), slope_trust(past, times)
    update = choose(predicted, trust, least_gain=0.01, least_update=2)
    assert predicted.shape == (5, 2, 3) and trust.shape == update.shape == (2, 3)
    for lane in np.ndindex(2, 3):
        at = (slice(None), *lane)
        np.testing.assert_allclose(predicted[at], predicted_regret(q[at], policy[at]))
        assert trust[lane] == pytest.approx(slope_trust(past[at], times))
        assert update[lane] == choose(predicted[at], trust[lane], least_gain=0.01, least_update=2)
    assert len(set(update.ravel().tolist())) > 1


def test_the_change_of_advantages_is_that_of_the_two_ends() -> None:
    """(0, 2) to (5, 4): the mean is taken off, (-1, 1) to (.5, -.5). What lies between does not count."""
    q = np.array([[[0.0, 2.0]], [[99.0, 0.0]], [[5.0, 4.0]]])
    assert advantage_change(q) == pytest.approx(1.5)
    shared = q + np.array([0.0, 7.0, -3.0])[:, None, None]
    assert advantage_change(shared) == pytest.approx(1.5)
    lanes = np.stack([q, np.zeros_like(q)], 1)
    np.testing.assert_allclose(advantage_change(lanes), [1.5, 0.0])


def test_a_change_below_the_least_one_is_no_reason_to_hold() -> None:
    predicted = np.array([1.0, 2.0, 3.0])
    assert choose(predicted, None, np.array(0.2), least_change=0.1) == 1
    assert choose(predicted, None, np.array(0.1), least_change=0.1) == 3
    assert choose(predicted, None, None, least_change=0.1) == 1
