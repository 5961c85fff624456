"""ForQ: a future Q function as a weighted sum of past ones (paper, section "Future Q value estimator").

    Qtilde(s, a) = sum_k w_k Q_k(s, a),    w = Phi^T (Phi Phi^T)^{-1} phi(t_q)

is the least-squares fit of basis functions of time through Q_k(s, a) at times x_k, read at t_q.
The weights are the same for every (s, a). Column k of Phi is phi(x_k); the paper prints the
inverse with the shapes the other way round.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtcore.config import ForecastConfig
from rtcore.windows import Window

Floats = NDArray[np.float64]

_RANK = 1e-12  # of the times' size: smaller singular values are rounding, as of sin(pi k), and are left out


def fit(config: ForecastConfig, time_k: Sequence[float], query: float) -> Floats:
    """Weights of past Q functions in the forecast.

    Each basis function but the constant is taken relative to its mean over the past. That leaves the fit
    as it is, parts the constant from the others, and so lets `shrink` (lambda) reach the others alone:

        w = 1/n + Psi^T (Psi Psi^T + lambda I)^+ psi(t_q),    psi(t) = phi(t) - mean_k phi(x_k)

    The weights sum to 1 whatever the shrinkage: shrinking the constant too would rescale Q. In the
    identity basis w_k = 1/n + (t_q - xbar) (x_k - xbar) / (Sxx + lambda), Sxx = sum_k (x_k - xbar)^2.

    Args:
        config: `basis` and its parameters; `shrink`. "constant" averages, "identity" extrapolates a line.
        time_k: [n], n >= 1, when each past Q was reached, in units, relative to t_m.
        query: t_q on the same axis.

    Returns:
        [n]. With n below the number of basis functions, only the first n of these are fitted. With one
        time, or equal times, it is 1/n each.
    """
    time = np.asarray(time_k, np.float64)
    assert time.ndim == 1 and len(time) >= 1, "time_k must be [n] with n >= 1"
    average: Floats = np.full(len(time), 1.0 / len(time))
    columns = _features(config, np.append(time, query) - time.mean())[: len(time) - 1]
    if not len(columns):
        return average
    columns -= columns[:, :-1].mean(1, keepdims=True)
    left, size, right = np.linalg.svd(columns[:, :-1], full_matrices=False)
    kept = size > _RANK * max(1.0, float(np.abs(time).max()))
    gain = size[kept] / (size[kept] ** 2 + config.shrink)
    change: Floats = right[kept].T @ (gain * (left[:, kept].T @ columns[:, -1]))
    change -= change.mean()  # so that the sum stays 1 where the fit is so bad that rounding shows
    return average + change


def horizon(config: ForecastConfig, window: Window, age_units: float) -> float:
    """How far ahead of t_m a forecast looks, in units.

    Args:
        config: `horizon`: a number of units; "window", its length, as in the paper, or of its update phase
            if it never ends; "replay", that and `age_units`.
        window: which begins at t_m.
        age_units: mean age of what the Q functions are learned from: they show the world as it was then.
    """
    if not isinstance(config.horizon, str):
        return float(config.horizon)
    length = float(window.update if window.hold is None else window.update + window.hold)
    return length + age_units if config.horizon == "replay" else length


def _features(config: ForecastConfig, time: Floats) -> Floats:
    """The basis functions but the constant, [d - 1, n + 1], at `time`, [n + 1]: the past, then the query.

    Each has a slope of at most 1 per unit over the past. `shrink` is then in units squared in every basis.
    """
    match config.basis:
        case "constant":
            return np.empty((0, len(time)))
        case "identity":
            return time[None].copy()
        case "polynomial":
            power = np.arange(1.0, config.degree + 1)[:, None]
            span = float(np.abs(time[:-1]).max()) or 1.0
            powers: Floats = span / power * (time / span) ** power
            return powers
        case "fourier":
            omega = 2 * np.pi * np.arange(1.0, config.harmonics + 1)[:, None] / config.period
            waves = np.stack([np.sin(omega * time), np.cos(omega * time)], 1) / omega[:, None]
            return waves.reshape(-1, len(time))
