"""Intervals of a mean over seeds. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

_HALVINGS = 60  # of [0, 90 degrees]: the quantile's angle to the last bit


@dataclass(frozen=True)
class Interval:
    """A mean, and half the width of its 95 % interval."""

    mean: float
    half: float

    @property
    def apart(self) -> bool:
        """Whether 0 lies outside."""
        return abs(self.mean) > self.half

    def __str__(self) -> str:
        return f"{self.mean:z.2f} ± {self.half:.2f}"


def interval(values: ArrayLike) -> Interval:
    """Of the mean of n >= 2 independent values, by Student's t."""
    seen = np.asarray(values, np.float64)
    return Interval(float(seen.mean()), float(half_widths(seen)))


def half_widths(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Half the widths of the 95 % intervals of means over the first axis, [n, ...] -> [...], n >= 2."""
    n = len(values)
    assert n >= 2, "an interval needs two values"
    halves: NDArray[np.float64] = student_quantile(n - 1) * values.std(axis=0, ddof=1) / math.sqrt(n)
    return halves


def student_quantile(freedom: int) -> float:
    """The two-sided 95 % quantile of Student's t with so many degrees of freedom, >= 1."""
    low, high = 0.0, math.pi / 2
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if _inside(middle, freedom) < 0.95 else (low, middle)
    return math.sqrt(freedom) * math.tan(low)


def _inside(angle: float, freedom: int) -> float:
    """P(|T| < sqrt(freedom) tan(angle)), a finite sum (Abramowitz and Stegun, 26.7.3 and 26.7.4)."""
    cosine, term, total = math.cos(angle), 1.0, 1.0
    for k in range(2 + freedom % 2, freedom - 1, 2):
        term *= (k - 1) / k * cosine**2
        total += term
    if freedom % 2 == 0:
        return math.sin(angle) * total
    return 2 / math.pi * (angle + (math.sin(angle) * cosine * total if freedom > 1 else 0.0))
