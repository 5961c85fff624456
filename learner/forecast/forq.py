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

from rtcore.config import Basis


def forq_weights(
    time_k: Sequence[float], query: float, *, basis: Basis = "identity", shrink: float = 0.0
) -> NDArray[np.float64]:
    """Weights of past Q functions in the forecast.

    Times are centred on their mean first. That leaves the fit as it is, makes Phi Phi^T of the
    identity basis the diagonal (n, Sxx), and so lets `shrink` reach the slope alone:

        w_k = 1/n + (t_q - xbar) (x_k - xbar) / (Sxx + shrink),    Sxx = sum_k (x_k - xbar)^2

    The weights sum to 1 whatever the shrinkage: shrinking the intercept too would rescale Q.

    Args:
        time_k: [n], n >= 1, when each past Q was reached, in units, relative to t_m.
        query: t_q on the same axis.
        basis: "constant" averages, "identity" extrapolates a line.
        shrink: added to Sxx, in units squared, >= 0.

    Returns:
        [n]. With one time, or equal times, there is no slope to fit and it is 1/n each.
    """
    time = np.asarray(time_k, np.float64)
    assert time.ndim == 1 and len(time) >= 1, "time_k must be [n] with n >= 1"
    assert shrink >= 0, "shrink must be >= 0"
    centre = time.mean()
    phi_k, phi_q = _features(time - centre, basis), _features(np.array([query - centre]), basis)
    gram = phi_k @ phi_k.T
    gram[1:, 1:] += shrink * np.eye(len(gram) - 1)
    weights: NDArray[np.float64] = phi_k.T @ np.linalg.pinv(gram) @ phi_q[:, 0]
    return weights


def _features(time: NDArray[np.float64], basis: Basis) -> NDArray[np.float64]:
    """Phi: [d, n], the constant first."""
    one = np.ones_like(time)
    return np.stack([one] if basis == "constant" else [one, time])
