"""The schedule `auto_bound`: the split that Theorem 1 prefers, by hand and against exact values."""

from __future__ import annotations

import math

import numpy as np
import pytest

from learner.schedule.bound import Floats, bound_choice, start_distances
from learner.theory import values
from rtcore.config import ConfigError

UNIFORM = np.log([[0.5, 0.5]])
FORECAST = np.array([[math.log(3.0), 0.0]])  # softmax with tau = 1: 3/4, 1/4
DIVERGENCE = math.log(4 / 3) / 2  # 1/2 log(1/2 / (3/4)) + 1/2 log(1/2 / (1/4))


def _choice(steepest: float, *, eta: float) -> int:
    slope = np.array([[-steepest, 0.5 * steepest]])
    return int(bound_choice(UNIFORM, FORECAST, slope, window=5, eta=eta, tau=1.0, gamma=0.5))


def test_distances_by_hand() -> None:
    """gamma tau / (1 - gamma) is 1 here; log pi differs most where it is 1/2 in place of 1/4."""
    value, distance = start_distances(UNIFORM, FORECAST, tau=1.0, gamma=0.5)
    assert value == pytest.approx(DIVERGENCE)
    assert distance == pytest.approx(math.log(2.0))
    # a second state with no error leaves the largest, and a tau of 2 with twice the forecast only scales
    both = np.concatenate([UNIFORM, UNIFORM]), np.concatenate([FORECAST, 0 * FORECAST])
    assert start_distances(*both, tau=1.0, gamma=0.5) == pytest.approx((value, distance))
    assert start_distances(UNIFORM, 2 * FORECAST, tau=2.0, gamma=0.5) == pytest.approx((2 * value, distance))


@pytest.mark.parametrize(
    ("eta", "c1", "saved"),
    [
        # x = 1/2 = 1 - gamma, so C_1 has no log pi; R^pi / C_1 is 31/16 for N = 0 and 1, 2 for N = 2
        (0.5, 2.5 * DIVERGENCE, 1 / 16),
        # x = 1/4: half of 2 tau ||log pi* - log pi|| stays; 1/4 (3/4)^3 more for N = 2 than for N = 1
        (0.25, 2.5 * (DIVERGENCE + math.log(2.0)), 27 / 256),
    ],
)
def test_the_hold_grows_with_the_drift(eta: float, c1: float, saved: float) -> None:
    """W = 5. The budgets in R^env are b (10, 6, 4, 4, 6) for N = 0 .. 4, times C_4 = 2 / (1 - gamma) = 4.

    N = 1 costs no R^pi, so any drift has it. N = 2 has 8 b less than that, b = slope / 2, which pays for the
    R^pi from slope = C_1 saved / 4 on. N = 3 would save nothing more.
    """
    turn = c1 * saved / 4
    slopes = (0.0, 1e-6 * turn, (1 - 1e-6) * turn, (1 + 1e-6) * turn, 1e6 * turn)
    assert [_choice(slope, eta=eta) for slope in slopes] == [5, 4, 4, 3, 3]


def test_rounding_is_no_drift() -> None:
    """A policy that has arrived has C_1 = 0, and then any drift would have the window halved."""
    equal, slope = np.ones((1, 2)), np.full((1, 2), 1e-17)
    rest = {"eta": 0.5, "tau": 1.0, "gamma": 0.5}
    np.testing.assert_array_equal(start_distances(UNIFORM, equal, tau=1.0, gamma=0.5), 0.0)
    assert bound_choice(UNIFORM, equal, slope, window=5, **rest) == 5
    assert bound_choice(UNIFORM, equal, slope + 0.1, window=5, **rest) == 3


def test_the_value_distance_is_a_bound() -> None:
    """On random MDPs, where Q*_tau and Q_tau of a policy are known."""
    rng = np.random.default_rng(0)
    gamma, tau, shape = 0.9, 0.1, (50, 4, 3)
    reward, transition = rng.random(shape), rng.dirichlet(np.full(4, 0.3), shape)
    log_policy = np.log(rng.dirichlet(np.ones(3), shape[:2]))
    best = values.soft_optimal(reward, transition, gamma=gamma, tau=tau)
    own = values.soft_evaluate(reward, transition, log_policy, gamma=gamma, tau=tau)
    apart = np.abs(best.q - own.q).max((-2, -1))
    bound, distance = start_distances(log_policy, best.q, tau=tau, gamma=gamma)
    assert (apart <= bound).all() and (apart / bound).max() > 0.5
    np.testing.assert_allclose(distance, np.abs(best.log_policy - log_policy).max((-2, -1)), rtol=1e-6)


def test_lanes_are_single_calls() -> None:
    rng = np.random.default_rng(1)
    log_policy = np.log(rng.dirichlet(np.ones(2), (3, 2, 4)))
    forecast, slope = (
        rng.normal(size=(3, 2, 4, 2)),
        10.0 ** rng.uniform(-4, 1, (3, 2, 1, 1)) * np.ones((4, 2)),
    )

    def choice(log_policy: Floats, forecast: Floats, slope: Floats) -> list[int]:
        found = bound_choice(log_policy, forecast, slope, window=20, eta=0.5, tau=0.1, gamma=0.9)
        return np.ravel(found).tolist()

    lanes = choice(log_policy, forecast, slope)
    single = [choice(log_policy[at], forecast[at], slope[at])[0] for at in np.ndindex(3, 2)]
    assert lanes == single and len(set(lanes)) > 1


def test_a_rate_that_cannot_be() -> None:
    with pytest.raises(ConfigError, match=r"eta.*\(0, \(1 - gamma\) / tau\]"):
        _choice(0.1, eta=0.6)
