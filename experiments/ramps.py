"""The motivating example in numbers: linear ramps against a switch at an unknown time. Pure.

Two arms pay 1 or 0. Arm a_1 pays until the switch and a_0 from then on; the switch is uniform over [0, T), so
in unit t = 0 .. T - 1 it has come with probability t / T. A policy is beta_t, the probability of a_0, fixed
beforehand (paper, section 1). All of it is linear in beta, so its expectations are exact sums.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Ramp:
    """beta_t rises from 0 in unit `begin` to 1 in unit `begin` + `span`, on a line."""

    begin: int
    span: int

    def beta(self, units: int) -> Floats:
        """beta_t for t = 0 .. `units` - 1."""
        return np.clip((np.arange(units) - self.begin) / self.span, 0.0, 1.0)


def swapped(units: int) -> Floats:
    """P(the arms have swapped in unit t), float64 [units]."""
    return np.arange(units) / units


def expected_rewards(beta: Floats) -> Floats:
    """E[reward in unit t] = (1 - beta_t) (1 - t / T) + beta_t t / T; [..., T]."""
    p = swapped(beta.shape[-1])
    return (1 - beta) * (1 - p) + beta * p


def average(beta: Floats) -> Floats:
    """The expected average reward over the T units; [...]."""
    return np.asarray(expected_rewards(beta).mean(axis=-1))


def rewards_given(beta: Floats, first: int) -> Floats:
    """E[reward in unit t] when `first` is the first unit in which the arms are swapped; [T]."""
    return np.where(np.arange(len(beta)) < first, 1 - beta, beta)


def by_switch(beta: Floats) -> Floats:
    """The average reward for each first swapped unit 1 .. T, which are equally likely; [T]."""
    return np.array([rewards_given(beta, first).mean() for first in range(1, len(beta) + 1)])


def in_the_limit(begin: float, span: float) -> float:
    """The expected average reward of a ramp within [0, T] for many units: 1/2 + c (1 - c) - w^2 / 12,
    with w = `span` its length and c = `begin` + w / 2 its middle, both as shares of T.

    The integral of (1 - beta) (1 - p) + beta p over p in [0, 1], by parts: the ramp's slope 1 / w times the
    integral of p - p^2 over it.
    """
    middle = begin + span / 2
    return 0.5 + middle * (1 - middle) - span**2 / 12


def best_span(units: int, begin: int) -> Ramp:
    """The ramp from `begin` with the highest expected average reward; the fastest of equals.

    In the limit its length is 3/4 (1 - 2 begin / T) of T, where the derivative of `in_the_limit` is 0.
    """
    ramps = [Ramp(begin, span) for span in range(1, units + 1)]
    return ramps[int(np.argmax(average(np.array([ramp.beta(units) for ramp in ramps]))))]


def best_ramp(units: int) -> Ramp:
    """The best of all ramps."""
    ramps = [best_span(units, begin) for begin in range(units)]
    return ramps[int(np.argmax([average(ramp.beta(units)) for ramp in ramps]))]
