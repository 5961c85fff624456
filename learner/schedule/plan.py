"""The schedule `auto`: how long to improve the policy in a window, from forecasts of all its units.

    q, policy    Qtilde_{t_m + k} and pi^g, k and g in 0 .. W, [W + 1, ..., S, A]
    past, times  what q was made from, [l, ..., S, A] and [l]
    G = choose(predicted_regret(q, policy), slope_trust(past, times), advantage_change(q), least_change=tau)

Pure functions on float64 arrays; what is before the states are lanes that do not see each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Index = NDArray[np.int64]

SHRINK = 10.0  # times the slopes' variance; residuals of neighbouring tables are far from independent

# Picked on 24 phases of the chain and 16 random MDPs that docs/headline.md does not report, from trusts of
# 0, 0.1, 0.25, 0.5, 0.75 and 0.9 and gains of 0, 0.05, 0.1 and 0.2: of the pairs whose regret is at most
# 1.05 times the best fixed G's in hindsight by its whole interval, the one that holds least where nothing
# changes. There it is 1.02 [1.00, 1.04] with a mean N of 0.1; without trust it is 0.92, and N = 3.
LEAST_TRUST = 0.5
LEAST_GAIN = 0.05
ROUNDING = 1e-12  # of the largest Q: a loss below is no loss; sums of so few doubles round to 1e-15


def predicted_regret(q: Floats, policy: Floats) -> Floats:
    """The regret of a window that forecasts predict, summed over its units, for each G.

        predicted(G) = sum_{k=0}^{W} mean_s [max_a Qtilde_k(s, a) - sum_a pi^{min(k, G)}(a|s) Qtilde_k(s, a)]

    The last unit, t_{m+1}, counts: pi^G still acts in it. The advantages of the paper's regret, with the
    forecast in place of Q* and all states alike in place of those that are visited.

    Args:
        q: Qtilde_{t_m + k}, [W + 1, ..., S, A], in units of return.
        policy: pi^g(a|s), [W + 1, ..., S, A].

    Returns:
        For G = 1 .. W, [W, ...].
    """
    assert q.shape == policy.shape and len(q) >= 2, "both must be [W + 1, ..., S, A], W >= 1"
    earned = np.einsum("k...sa,g...sa->kg...", q, policy) / q.shape[-2]
    gap = q.max(-1).mean(-1)[:, None] - earned
    gap = np.where(gap > ROUNDING * np.abs(q).max((0, -2, -1)), gap, 0.0)
    k = np.arange(len(q))
    return np.stack([gap[k, np.minimum(k, update)].sum(0) for update in k[1:]])


def slope_trust(past: Floats, times: Floats) -> Floats:
    """How much of what the past tables' slopes show is not noise, rho in [0, 1], one number per lane.

        rho = clip(1 - 10 sum_{s,a} se^2 / sum_{s,a} slope^2, 0, 1)

    after James and Stein (1961); the slopes are those of least squares, and se^2 would be their variance if
    the residuals were independent.

    Args:
        past: [l, ..., S, A].
        times: of the tables, [l], in any unit and order.

    Returns:
        rho, [...]; 0 with fewer than three tables, which leave no residuals, and where nothing has a slope.
    """
    number = len(past)
    assert np.shape(times) == (number,), "there must be a time for each table"
    centred = np.asarray(times, np.float64) - np.mean(times)
    spread = float((centred**2).sum())
    if number < 3 or spread == 0.0:
        return np.zeros(past.shape[1:-2])
    slope = np.tensordot(centred, past, 1) / spread
    residual = past - past.mean(0) - np.multiply.outer(centred, slope)
    noise = SHRINK * (residual**2).sum((0, -2, -1)) / ((number - 2) * spread)
    size = (slope**2).sum((-2, -1))
    trust: Floats = np.where(size > noise, 1.0 - noise / np.where(size > 0.0, size, 1.0), 0.0)
    return trust


def advantage_change(q: Floats) -> Floats:
    """By how much the forecasts of a window change what one action is worth more than another.

        max_{s,a} |A_W(s, a) - A_0(s, a)|,    A_k(s, a) = Qtilde_k(s, a) - mean_a' Qtilde_k(s, a')

    A policy that goes to softmax(Q / tau) does not see what all actions of a state share, and hardly sees a
    change below tau. Tables that settle still change by that much, and steadily, long after a drift ended.

    Args:
        q: Qtilde_{t_m + k}, [W + 1, ..., S, A].

    Returns:
        [...], in units of return.
    """
    ends = q[[0, -1]]
    first, last = ends - ends.mean(-1, keepdims=True)
    change: Floats = np.abs(last - first).max((-2, -1))
    return change


def choose(
    predicted: Floats,
    trust: Floats | None = None,
    change: Floats | None = None,
    *,
    least_change: float = 0.0,
    least_gain: float = LEAST_GAIN,
    least_trust: float = LEAST_TRUST,
    least_update: int = 1,
) -> Index:
    """The G of the least predicted regret, or W where the prediction is not worth a hold.

    Noise looks like drift: a line through noise goes somewhere, and a policy that is held is predicted to
    gain from that. So it is not trust that scales the gain; without enough of it there is no hold.

    Args:
        predicted: for G = 1 .. W, [W, ...].
        trust: rho of `slope_trust`, [...]; None: forecasts are trusted.
        change: of `advantage_change`, [...]; None: it does not count.
        least_change: G = W unless the change is above it: the policy's temperature tau.
        least_gain: G = W unless another one saves something, and this share of what is predicted for W.
        least_trust: G = W unless rho is above it.
        least_update: G is at least this; in 1 .. W.

    Returns:
        G, [...]; the smallest of equals.
    """
    window = len(predicted)
    assert 1 <= least_update <= window, "least_update must be in 1 .. W"
    allowed = predicted[least_update - 1 :]
    held: Index = allowed.argmin(0) + least_update
    gain = predicted[-1] - allowed.min(0)
    worth = (gain >= least_gain * predicted[-1]) & (gain > 0.0)
    if trust is not None:
        worth &= trust > least_trust
    if change is not None:
        worth &= change > least_change
    return np.where(worth, held, window)
