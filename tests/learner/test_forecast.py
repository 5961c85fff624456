from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from learner.forecast.forq import fit, horizon
from rtcore.config import Basis
from rtcore.windows import Window
from tests.learner.small import forq

Floats = NDArray[np.float64]
BASES: list[dict[str, Any]] = [
    {"basis": "constant"},
    {"basis": "identity"},
    {"basis": "polynomial", "degree": 2},
    {"basis": "polynomial", "degree": 5},
    {"basis": "fourier", "period": 100.0, "harmonics": 1},
    {"basis": "fourier", "period": 7.5, "harmonics": 3},
]


def newest(length: int) -> list[float]:
    """Times of `length` snapshots, one a unit, the newest at t_m = 0."""
    return [float(time) for time in range(1 - length, 1)]


def weights(times: list[float], query: float, **fields: Any) -> Floats:
    return fit(forq(**fields), times, query)


def columns(time: Floats, basis: Basis) -> Floats:
    """phi as the paper's appendix reads: powers up to 2, or one wave of period 100 units."""
    angle = 2 * np.pi * time / 100
    rows = {
        "identity": [time, np.ones_like(time)],
        "polynomial": [time**2, time, np.ones_like(time)],
        "fourier": [np.sin(angle), np.cos(angle), np.ones_like(time)],
    }[basis]
    return np.stack(rows)


# ||w||_2 with a snapshot a unit, read h units after the newest. For the identity basis these are
# sqrt(1 / l_p + 12 (h + (l_p - 1) / 2)^2 / (l_p (l_p^2 - 1))): at l_p = h = 5, sqrt(0.2 + 12 * 49 / 120)
@pytest.mark.parametrize(
    ("basis", "l_p", "ahead", "norm"),
    [
        ("identity", 2, 1, 2.24), ("identity", 2, 10, 14.87), ("identity", 3, 5, 4.28),
        ("identity", 5, 1, 1.05), ("identity", 5, 5, 2.26), ("identity", 10, 10, 1.63),
        ("identity", 20, 20, 1.17), ("identity", 50, 20, 0.46),
        ("polynomial", 3, 1, 4.36), ("polynomial", 5, 1, 2.14), ("polynomial", 5, 5, 12.8),
        ("polynomial", 10, 10, 8.94), ("polynomial", 20, 20, 6.42),
        ("fourier", 3, 1, 4.35), ("fourier", 5, 5, 12.6), ("fourier", 10, 10, 8.36),
        ("fourier", 20, 20, 4.82),
    ],
)  # fmt: skip
def test_the_norm_of_the_weights(basis: Basis, l_p: int, ahead: int, norm: float) -> None:
    found = float(np.linalg.norm(weights(newest(l_p), ahead, basis=basis, l_p=l_p)))
    assert found == pytest.approx(norm, abs=0.05 if norm > 10 else 0.005)


@pytest.mark.parametrize("l_p", [5, 10, 15, 20])
def test_a_window_as_long_as_the_past_by_hand(l_p: int) -> None:
    # x_i = -(l_p - 1) .. 0, xbar = -(l_p - 1) / 2, Sxx = l_p (l_p^2 - 1) / 12, t_q = l_p:
    # w_i = 1 / l_p + (l_p + (l_p - 1) / 2) (x_i - xbar) / Sxx. At l_p = 5: 0.2 + 7 * (-2 .. 2) / 10
    middle = (l_p - 1) / 2
    wanted = [1 / l_p + (l_p + middle) * (x + middle) * 12 / (l_p * (l_p**2 - 1)) for x in range(1 - l_p, 1)]
    found = weights(newest(l_p), l_p, l_p=l_p)
    assert found == pytest.approx(wanted, abs=1e-12)
    if l_p == 5:
        assert found == pytest.approx([-1.2, -0.5, 0.2, 0.9, 1.6])


def test_two_points_make_a_line() -> None:
    assert weights([-1, 0], 3) == pytest.approx([-3, 4])


def test_three_points_make_a_parabola() -> None:
    # Lagrange's polynomials of -2, -1, 0, read at 1: (1 * 2 / 2, -3 * 1, 3 * 2 / 2) = (1, -3, 3)
    assert weights([-2, -1, 0], 1, basis="polynomial", degree=2) == pytest.approx([1, -3, 3])


def test_a_whole_period_sampled_comes_round() -> None:
    # with a period of 4 units and snapshots at -3 .. 0, t = 1 is where t = -3 was; sin, cos and 1 leave the
    # fourth direction (1, -1, 1, -1) / 2 out: (1, 0, 0, 0) - (1, -1, 1, -1) / 4
    found = weights(newest(4), 1, basis="fourier", period=4.0)
    assert found == pytest.approx([0.75, 0.25, -0.25, 0.25])


def test_three_points_by_hand() -> None:
    # xbar = -1, Sxx = 2, t_q - xbar = 3: 1/3 + 3 * (-1, 0, 1) / 2
    assert weights([-2, -1, 0], 2) == pytest.approx([1 / 3 - 1.5, 1 / 3, 1 / 3 + 1.5])


def test_shrinking_the_slope_by_hand() -> None:
    # Sxx + shrink = 2 + 4: 1/3 + 3 * (-1, 0, 1) / 6
    assert weights([-2, -1, 0], 2, shrink=4.0) == pytest.approx([1 / 3 - 0.5, 1 / 3, 1 / 3 + 0.5])


@pytest.mark.parametrize("basis", BASES[1:])
def test_shrunk_without_end_it_averages(basis: dict[str, Any]) -> None:
    assert weights(newest(8), 5, shrink=1e12, l_p=8, **basis) == pytest.approx([1 / 8] * 8, abs=1e-6)


def test_a_long_wave_is_shrunk_as_a_line_is() -> None:
    # the columns of a wave much longer than the past are time itself, and one that hardly changes
    wave = weights(newest(5), 5, basis="fourier", period=1e4, l_p=5, shrink=10.0)
    assert wave == pytest.approx(weights(newest(5), 5, l_p=5, shrink=10.0), abs=0.05)


def test_the_constant_basis_averages() -> None:
    assert weights(newest(4), 9, basis="constant", shrink=2.0) == pytest.approx([0.25] * 4)


@pytest.mark.parametrize("basis", ["identity", "polynomial", "fourier"])
def test_the_paper_formula_on_uncentred_times(basis: Basis) -> None:
    time, query = np.array([-17.0, -14.0, -9.0, -7.0, -4.0, -3.0, 0.0]), 5.0  # units were missed
    phi, phi_q = columns(time, basis), columns(np.array([query]), basis)[:, 0]
    wanted = phi.T @ np.linalg.inv(phi @ phi.T) @ phi_q
    assert weights(time.tolist(), query, basis=basis, l_p=7) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("basis", ["identity", "polynomial", "fourier"])
def test_it_reads_off_the_least_squares_fit(basis: Basis) -> None:
    time, q = np.array(newest(9)), np.random.default_rng(0).standard_normal(9)
    coefficients, *_ = np.linalg.lstsq(columns(time, basis).T, q, rcond=None)
    wanted = float(coefficients @ columns(np.array([6.0]), basis)[:, 0])
    assert weights(time.tolist(), 6, basis=basis, l_p=9) @ q == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("times", [[-3.0], [2.0, 2.0]])
def test_without_a_slope_to_fit_it_is_the_mean(times: list[float]) -> None:
    assert weights(times, 10) == pytest.approx([1 / len(times)] * len(times))


def test_with_few_snapshots_it_fits_what_they_can_bear() -> None:
    assert weights([-1, 0], 3, basis="polynomial", degree=4) == pytest.approx([-3, 4])
    assert weights([-1], 3, basis="fourier") == pytest.approx([1.0])


@given(
    basis=st.sampled_from(BASES),
    times=st.lists(st.integers(-50, 5), min_size=1, max_size=20, unique=True),
    query=st.floats(0, 50),
    shrink=st.sampled_from([0.0, 0.3, 20.0, 1e4]),
)
def test_the_weights_sum_to_one(basis: dict[str, Any], times: list[int], query: float, shrink: float) -> None:
    found = weights([float(time) for time in sorted(times)], query, shrink=shrink, **basis)
    assert math.fsum(found) == pytest.approx(1.0, abs=1e-9 * max(1.0, float(np.linalg.norm(found))))


@given(slope=st.floats(-5, 5), level=st.floats(-5, 5), query=st.floats(0, 20))
def test_a_straight_line_is_forecast_exactly(slope: float, level: float, query: float) -> None:
    times = newest(6)
    forecast = weights(times, query) @ (level + slope * np.array(times))
    assert forecast == pytest.approx(level + slope * query, abs=1e-9)


@pytest.mark.parametrize(
    ("configured", "hold", "units"),
    [
        ("window", 2, 5.0),
        ("window", None, 3.0),
        ("replay", 2, 5.0 + 7.5),
        ("replay", None, 3.0 + 7.5),
        (4.5, 2, 4.5),
        (0, 2, 0.0),
    ],
)
def test_the_horizon(configured: float | Literal["window", "replay"], hold: int | None, units: float) -> None:
    window = Window(m=1, start=4, update=3, hold=hold)
    assert horizon(forq(horizon=configured), window, 7.5) == units
