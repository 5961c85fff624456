"""The exponential envelope of a variation budget (Assumption 1), fitted to changes that were seen. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learner.theory.optimum import LARGEST, geometric_sum

Floats = NDArray[np.float64]

# Of ln alpha. Below: a single jump asks for alpha -> 1, and Assumption 1 for alpha > 1. Above: a budget that
# grows twentyfold a unit is a jump.
LEAST_RATE, LARGEST_RATE, RATES = 1e-3, 3.0, 600


@dataclass(frozen=True)
class Envelope:
    """B alpha^j over the variation budget of one phase.

    Attributes:
        budget: the largest B(t1, t1 + j) over all begins t1 of the phase, j = 0 .. W - 1, [W].
        scale: B. 0 where nothing changed.
        growth: alpha, above 1; 1 where nothing changed.
        begins: how many begins there were.
    """

    budget: Floats
    scale: float
    growth: float
    begins: int


def fit(changes: Floats, begins: Sequence[int], length: int) -> Envelope:
    """The envelope B alpha^j >= B(t1, t1 + j) of the least sum over j = 0 .. W - 1, which enters R^env.

    For each alpha the least B is the largest ratio of the two sides; alpha is searched on a grid.

    Args:
        changes: b[t], [T - 1].
        begins: the t1, at least one, in [0, T).
        length: W. What reaches past the last change is left out.
    """
    budget, summed = np.zeros(length), np.concatenate(([0.0], np.cumsum(changes)))
    for begin in begins:
        since = summed[begin : begin + length] - summed[begin]
        budget[: len(since)] = np.maximum(budget[: len(since)], since)
    if not budget.any():
        return Envelope(budget, 0.0, 1.0, len(begins))
    ahead_of, best = np.arange(length), (np.inf, 0.0, 1.0)
    for rate in np.geomspace(LEAST_RATE, min(LARGEST_RATE, 0.99 * LARGEST / length), RATES):
        scale = float((budget * np.exp(-rate * ahead_of)).max())
        growth = float(np.exp(rate))
        best = min(best, (scale * geometric_sum(growth, length), scale, growth))
    return Envelope(budget, best[1], best[2], len(begins))
