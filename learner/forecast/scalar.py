"""Forecasts of a scalar that was observed once per unit, and the choice between them by their past errors.

Four forecasters of z at h units after the newest value z_n:

    persistence  z_n
    line         least squares through the last 6 values, read at n + h
    level        mean of the last 3 values
    ar           z_{t+1} = c + a1 z_t + a2 z_{t-1}, iterated h times; fitted to the last 60 values, with
                 1e-2 (c^2 + (a1 - 1)^2 + a2^2) added to the squared errors: a ridge towards persistence

The choice follows Gama, Sebastiao & Rodrigues (2013), "On evaluating stream learning algorithms": errors
are forgotten exponentially, e <- 0.85 e + (one-step error)^2, and the least e wins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Series = NDArray[np.float64]

NAMES = ("persistence", "line", "level", "ar")
MEMORY = 60  # no forecaster looks further back
FORGETTING = 0.85  # a drift's change of kind is noticed after about 1 / (1 - 0.85) = 7 units

_LINE, _LEVEL, _RIDGE = 6, 3, 1e-2


def persistence(series: Series, horizon: float) -> float:
    """The newest value, whatever the horizon."""
    del horizon
    return float(series[-1])


def line(series: Series, horizon: float) -> float:
    """Least-squares line through the last 6 values; with one value, that value."""
    recent = series[-_LINE:]
    age = np.arange(len(recent)) - (len(recent) - 1) / 2  # centred: intercept and slope come apart
    spread = float(age @ age)
    slope = float(age @ recent) / spread if spread else 0.0
    return float(recent.mean()) + slope * ((len(recent) - 1) / 2 + horizon)


def level(series: Series, horizon: float) -> float:
    """Mean of the last 3 values: for values that are noise about a level."""
    del horizon
    return float(series[-_LEVEL:].mean())


def ar(series: Series, horizon: float) -> float:
    """Second-order autoregression; between two whole horizons, on the line that joins their forecasts.

    Kept within the range of the last 60 values, widened by its own width at both ends: a fit with a root
    above 1 would otherwise grow without bound over a long horizon.
    """
    recent = series[-MEMORY:]
    if len(recent) < 3:
        return persistence(recent, horizon)
    features = np.stack([np.ones(len(recent) - 2), recent[1:-1], recent[:-2]])
    change = recent[2:] - recent[1:-1]  # with persistence taken off, the ridge is towards zero
    c, a1, a2 = np.linalg.solve(features @ features.T + _RIDGE * np.eye(3), features @ change)
    path = [float(recent[-2]), float(recent[-1])]
    for _ in range(math.ceil(horizon)):
        path.append(c + (1.0 + a1) * path[-1] + a2 * path[-2])
    beyond = horizon - math.floor(horizon)
    ahead = path[-1] if not beyond else (1.0 - beyond) * path[-2] + beyond * path[-1]
    low, high = float(recent.min()), float(recent.max())
    return float(np.clip(ahead, 2 * low - high, 2 * high - low))


_FORECASTERS = (persistence, line, level, ar)


def candidates(series: Sequence[float] | Series, horizon: float) -> Series:
    """What each of `NAMES` says, [4].

    Args:
        series: [n], n >= 1, one value per unit, oldest first; only the last 60 matter.
        horizon: h > 0 in units after the newest value.
    """
    values = np.asarray(series, np.float64)
    assert values.ndim == 1 and len(values) >= 1, "series must be [n] with n >= 1"
    assert horizon >= 0, "horizon must be >= 0"
    return np.array([forecaster(values, horizon) for forecaster in _FORECASTERS])


class Contest:
    """Which forecaster has been right lately.

    Attributes:
        errors: [4], e of each: squared one-step errors, forgotten exponentially.
        weight: sum of the factors in `errors`; 0 as long as nothing was judged.
    """

    def __init__(self) -> None:
        self.errors: Series = np.zeros(len(NAMES))
        self.weight = 0.0

    def judge(self, series: Series, reached: float) -> None:
        """Hold each one-step forecast from `series` against the value that followed."""
        self.errors = FORGETTING * self.errors + (candidates(series, 1.0) - reached) ** 2
        self.weight = FORGETTING * self.weight + 1.0

    @property
    def best(self) -> int:
        """Index in `NAMES` of the least error; of equals the first, so persistence before any judgement."""
        return int(np.argmin(self.errors))

    def rms(self) -> Series:
        """[4], root of the weighted mean square one-step error; 0 as long as nothing was judged."""
        return np.sqrt(self.errors / self.weight) if self.weight else np.zeros(len(NAMES))
