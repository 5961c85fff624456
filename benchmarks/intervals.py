"""Intervals for a handful of seeds."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence

# Two-sided 95 % quantiles of Student's t by degrees of freedom.
STUDENT_T = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 5: 2.571, 6: 2.447, 7: 2.365, 8: 2.306, 9: 2.262}


def check_seeds(seeds: int) -> None:
    """Refuse, before anything runs, a number of seeds that gives no interval.

    Raises:
        SystemExit: not 2 to 10.
    """
    if seeds - 1 not in STUDENT_T:
        raise SystemExit(f"seeds = {seeds}: must be 2 to {max(STUDENT_T) + 1}")


def half_interval(values: Sequence[float]) -> float:
    """Half the width of the 95 % interval of the mean, for 2 to 10 independent values."""
    spread = statistics.stdev(values)
    return STUDENT_T[len(values) - 1] * spread / math.sqrt(len(values))
