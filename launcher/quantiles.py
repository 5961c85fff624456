"""The figures that stand for many durations: p50, p99, p99.9 and the largest."""

from __future__ import annotations

from math import ceil

import numpy as np
import numpy.typing as npt

Nanoseconds = npt.NDArray[np.int64]
Quantiles = dict[str, float | None]  # {p50, p99, p999, max}, as in summary.json

SHARES = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}


def quantiles_us(values_ns: Nanoseconds) -> Quantiles:
    """{p50, p99, p999, max} in microseconds; None where there is no value.

    A quantile is the smallest value that at least this share of all values do not exceed, as in
    `rtcore.histogram`, but exactly.
    """
    if not len(values_ns):
        return dict.fromkeys(SHARES)
    ordered = np.sort(values_ns)
    ranks = {name: max(1, ceil(share * len(ordered))) for name, share in SHARES.items()}
    return {name: float(ordered[rank - 1]) / 1e3 for name, rank in ranks.items()}
