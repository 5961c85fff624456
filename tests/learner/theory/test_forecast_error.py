"""Propositions 1 and 2: by hand, and against forecasts in random worlds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from learner.forecast import forq
from learner.theory import forecast_error, values
from learner.theory.mdp import TimeElapsingMdp
from rtcore.config import ConfigError, ForecastConfig
from tests.learner.theory.worlds import random_world


def test_the_change_ahead_by_hand() -> None:
    # b_r = (1, 2), b_p = (0, 0.5 + 0.5), r_max = 3, gamma = 1/2, H = 2: h = 1.5, r_max / (1 - gamma) = 6
    reward = np.array([[[0.0], [0]], [[1], [0]], [[3], [0]]])
    moves = np.broadcast_to(np.eye(2)[None, :, None], (3, 2, 1, 2)).copy()
    moves[2, 0, 0] = [0.5, 0.5]
    world = TimeElapsingMdp(reward, moves, 0.5, 2)
    assert forecast_error.change_ahead(world, [0, 1, 2], 2) == pytest.approx(
        [1.5 * (3 + 6), 1.5 * (2 + 6), 0]
    )


def test_both_bounds_by_hand() -> None:
    # w = (3, -1): norm sqrt 10, sum 2. u + eps = (1, 3): sqrt 10. The corrected 10 + 1 * 7,
    w, u, eps = np.array([3.0, -1.0]), np.array([1.0, 0.0]), np.array([0.0, 3.0])
    assert forecast_error.forecast_bound(w, u, eps, q_max=7.0) == pytest.approx(17.0)
    # printed sqrt 10 sqrt(2 (1 + 9)) + 2 (sqrt 10 + 1) 7
    printed = math.sqrt(200) + 14 * (math.sqrt(10) + 1)
    assert forecast_error.forecast_bound_printed(w, u, eps, q_max=7.0) == pytest.approx(printed)


def test_what_the_printed_square_is_too_small_for() -> None:
    # One past table, w = 1, u = eps = 1: the error can be 2, but the first part says sqrt 2.
    one = np.ones(1)
    assert forecast_error.forecast_bound(one, one, one, q_max=0.0) == pytest.approx(2.0)
    assert forecast_error.forecast_bound_printed(one, one, one, q_max=0.0) == pytest.approx(math.sqrt(2))


def test_the_corollary_is_the_proposition_for_good_estimates() -> None:
    # l_p = 4, ||w|| = 1/2, u_max = 3: 2 * 1/2 * 3 * 2
    assert forecast_error.settled_bound(np.full(4, 0.25), 3.0, q_max=100.0) == pytest.approx(6.0)


@pytest.mark.parametrize("l_p", [2, 3, 5, 20, 50])
@pytest.mark.parametrize("ahead", [1, 5, 20])
def test_the_l_of_proposition_1_in_closed_form(l_p: int, ahead: int) -> None:
    # w_k = 1 / l_p + d (x_k - xbar) / Sxx with d = ahead + (l_p - 1) / 2 and Sxx = l_p (l_p^2 - 1) / 12, so
    # sum w = 1 and ||w||^2 = 1 / l_p + d^2 / Sxx; at l_p = 2, ahead = 1: 1/2 + 2.25 * 2 = 5
    weights = forq.fit(ForecastConfig(), [float(k) for k in range(1 - l_p, 1)], float(ahead))
    distance = ahead + (l_p - 1) / 2
    square = 1 / l_p + 12 * distance**2 / (l_p * (l_p**2 - 1))
    assert math.fsum(weights) == pytest.approx(1.0, abs=1e-12)
    assert float(weights @ weights) == pytest.approx(square, rel=1e-12)
    if (l_p, ahead) == (2, 1):
        assert square == 5.0


def test_no_forecast_in_a_random_world_is_further_off() -> None:
    rng, ratios = np.random.default_rng(0), []
    for _ in range(300):
        world = random_world(rng, 9)
        best = values.optimal(world.reward, world.transition, gamma=world.gamma, horizon=world.horizon).q
        l_p = int(rng.integers(1, 8))
        times = list(range(7 - l_p, 7))  # t_m = 6, t_{m+1} = 8
        eps = rng.choice([0.0, 1.0]) * rng.exponential(size=l_p)
        signs = rng.choice([-1, 1], size=(l_p, *best.shape[1:]))
        past = best[times] + eps[:, None, None] * signs
        weights = rng.normal(size=l_p) * 3
        if rng.random() < 0.7:
            weights = forq.fit(ForecastConfig(), [float(t - 6) for t in times], 2.0)
        off = np.abs(np.tensordot(weights, past, 1) - best[8]).max()
        u, q_max = forecast_error.change_ahead(world, times, 8), world.steps * world.r_max
        bound = forecast_error.forecast_bound(weights, u, eps, q_max=q_max)
        assert off <= bound * (1 + 1e-9) + 1e-9
        ratios.append(off / bound if bound > 1e-6 else 0.0)
    assert max(ratios) > 0.5


def test_how_long_proposition_2_says_to_wait() -> None:
    # 20^3.3 = 10^(3.3 * 1.30103) = 19 656, times 10^5.2 = 158 489
    found = forecast_error.units_needed(np.array([1.0, 2.0]), states=5, actions=4, gamma=0.9)
    assert found == pytest.approx([3.1146e9, 3.1146e9 / 2**2.6], rel=1e-3)


def test_what_bounds_nothing_is_refused() -> None:
    w = np.ones(2)
    with pytest.raises(ConfigError, match=r"weights.shape"):
        forecast_error.forecast_bound(np.empty(0), np.empty(0), np.empty(0), q_max=1.0)
    with pytest.raises(ConfigError, match=r"change.shape"):
        forecast_error.forecast_bound(w, np.ones(3), w, q_max=1.0)
    with pytest.raises(ConfigError, match=r"error = .*must be >= 0"):
        forecast_error.forecast_bound(w, w, -w, q_max=1.0)
    with pytest.raises(ConfigError, match="q_max"):
        forecast_error.forecast_bound(w, w, w, q_max=math.nan)
    with pytest.raises(ConfigError, match="error"):
        forecast_error.units_needed(0.0, states=1, actions=1, gamma=0.5)
    with pytest.raises(ConfigError, match="gamma"):
        forecast_error.units_needed(1.0, states=1, actions=1, gamma=1.0)
    with pytest.raises(ConfigError, match="states, actions"):
        forecast_error.units_needed(1.0, states=0, actions=1, gamma=0.5)
