from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from learner.forecast.forq import forq_weights


def newest(length: int) -> list[int]:
    """Times of `length` snapshots, one a unit, the newest at t_m = 0."""
    return list(range(1 - length, 1))


@pytest.mark.parametrize(
    ("l_p", "horizon", "norm"),
    [(2, 1, 2.24), (2, 10, 14.87), (3, 5, 4.28), (5, 1, 1.05), (5, 5, 2.26), (10, 10, 1.63), (20, 20, 1.17)],
)
def test_the_norm_of_the_identity_basis(l_p: int, horizon: int, norm: float) -> None:
    weights = forq_weights(newest(l_p), horizon)
    assert np.linalg.norm(weights) == pytest.approx(norm, abs=0.005)
    closed_form = 1 / l_p + 12 * (horizon + (l_p - 1) / 2) ** 2 / (l_p * (l_p**2 - 1))
    assert weights @ weights == pytest.approx(closed_form)


def test_two_points_make_a_line() -> None:
    assert forq_weights([-1, 0], 3) == pytest.approx([-3, 4])


def test_three_points_by_hand() -> None:
    # xbar = -1, Sxx = 2, t_q - xbar = 3: 1/3 + 3 * (-1, 0, 1) / 2
    assert forq_weights([-2, -1, 0], 2) == pytest.approx([1 / 3 - 1.5, 1 / 3, 1 / 3 + 1.5])


def test_shrinking_the_slope_by_hand() -> None:
    # Sxx + shrink = 2 + 4: 1/3 + 3 * (-1, 0, 1) / 6
    assert forq_weights([-2, -1, 0], 2, shrink=4.0) == pytest.approx([1 / 3 - 0.5, 1 / 3, 1 / 3 + 0.5])


def test_the_constant_basis_averages() -> None:
    assert forq_weights(newest(4), 9, basis="constant", shrink=2.0) == pytest.approx([0.25] * 4)


def test_the_paper_formula_on_uncentred_times() -> None:
    time, query = np.array([-7.0, -4.0, -3.0, 0.0]), 5.0  # units were missed
    features = np.stack([time, np.ones(4)])
    wanted = features.T @ np.linalg.inv(features @ features.T) @ np.array([query, 1.0])
    assert forq_weights(time.tolist(), query) == pytest.approx(wanted)


@pytest.mark.parametrize("times", [[-3], [2, 2]])
def test_without_a_slope_to_fit_it_is_the_mean(times: list[int]) -> None:
    assert forq_weights(times, 10) == pytest.approx([1 / len(times)] * len(times))


@given(
    times=st.lists(st.integers(-50, 5), min_size=1, max_size=20, unique=True),
    query=st.floats(0, 50),
    shrink=st.floats(0, 1e4),
)
def test_the_weights_sum_to_one(times: list[int], query: float, shrink: float) -> None:
    assert math.fsum(forq_weights(times, query, shrink=shrink)) == pytest.approx(1.0, abs=1e-9)


@given(slope=st.floats(-5, 5), level=st.floats(-5, 5), query=st.floats(0, 20))
def test_a_straight_line_is_forecast_exactly(slope: float, level: float, query: float) -> None:
    times = newest(6)
    forecast = forq_weights(times, query) @ (level + slope * np.array(times))
    assert forecast == pytest.approx(level + slope * query, abs=1e-9)
