"""By how much a weighted sum of past Q tables can miss the future one (paper, Propositions 1 and 2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from learner.theory import budgets
from learner.theory.bounds import optimal_gap
from learner.theory.budgets import Budget
from learner.theory.mdp import Floats, TimeElapsingMdp, check_discount
from rtcore.config import ConfigError


def change_ahead(world: TimeElapsingMdp, times: Sequence[int], until: int) -> Floats:
    """The u_t of Proposition 1 at each t of `times`, [n]: it bounds ||Q*_t - Q*_{t_{m+1}}||.

    t_{m+1} is `until`.

    u_t = h (B_r(t, t_{m+1}) + r_max / (1 - gamma) B_p(t, t_{m+1}))
    """
    reward, transition = budgets.reward_changes(world), budgets.transition_changes(world)
    ahead = [Budget(budgets.local(reward, t, until), budgets.local(transition, t, until)) for t in times]
    return np.array([optimal_gap(world.gamma, world.r_max, budget, world.horizon) for budget in ahead])


def forecast_bound(weights: Floats, change: Floats, error: Floats, *, q_max: float) -> float:
    """Proposition 1, corrected: a bound on ||Qtilde - Q*||_inf, Q* that of t_{m+1}.

        ||w||_2 sqrt(sum_t (u_t + eps_t)^2) + |sum_t w_t - 1| q_max

    From Qtilde - Q* = sum_t w_t (Qhat_t - Q*) + (sum_t w_t - 1) Q* by Cauchy and Schwarz. With weights that
    sum to 1, as ForQ's do, the last part is 0.

    Args:
        weights: w_t, [l_p], of Qtilde = sum_t w_t Qhat_t.
        change: u_t, [l_p], with ||Q*_t - Q*|| <= u_t.
        error: eps_t, [l_p], with ||Qhat_t - Q*_t|| <= eps_t.
        q_max: h r_max, which no |Q*| exceeds.

    Raises:
        ConfigError: no weights, lengths that differ, or a bound below 0.
    """
    w, u, eps = _columns(weights, change, error)
    return float(np.linalg.norm(w) * np.linalg.norm(u + eps)) + abs(float(w.sum()) - 1.0) * _size(q_max)


def forecast_bound_printed(weights: Floats, change: Floats, error: Floats, *, q_max: float) -> float:
    """Proposition 1 as printed: ||w|| sqrt(sum_t 2 max(u_t, eps_t)^2) + l_p (||w|| + 1) q_max.

    (u + eps)^2 is at most 4 max(u, eps)^2, not 2, so its first part is too small. Its last part counts
    w_t - 1 once for each t where sum_t w_t - 1 belongs: it is never 0, grows with l_p, and mostly hides that.
    """
    w, u, eps = _columns(weights, change, error)
    norm = float(np.linalg.norm(w))
    return norm * math.sqrt(2.0) * float(np.linalg.norm(np.maximum(u, eps))) + len(w) * (norm + 1.0) * _size(
        q_max
    )


def settled_bound(weights: Floats, u_max: float, *, q_max: float) -> float:
    """The corollary of Propositions 1 and 2, corrected; for estimates so good that eps_t <= u_t <= u_max.

        2 ||w|| u_max sqrt(l_p) + |sum_t w_t - 1| q_max

    Printed: ||w|| u_max sqrt(2 l_p) + l_p (||w|| + 1) q_max.
    """
    w = np.asarray(weights, np.float64)
    u = np.full(len(w), _size(u_max))
    return forecast_bound(w, u, u, q_max=q_max)


def units_needed(error: Floats | float, *, states: int, actions: int, gamma: float) -> Floats:
    """Proposition 2: after so many steps of one trajectory, Q-learning is within `error` of Q*.

        t >= (|S| |A|)^3.3 / ((1 - gamma)^5.2 eps^2.6)

    From Qu and Wierman (2020), theorem 7, whose conditions, constants and logarithms the paper leaves out:
    a number to report, not to wait for. With |S| |A| = 20, gamma = 0.9 and eps = 1 it is 3.1e9.
    """
    check_discount(gamma, None)
    size = np.asarray(error, np.float64)
    if not (size > 0).all():
        raise ConfigError("error", size.tolist(), "must be > 0")
    if states < 1 or actions < 1:
        raise ConfigError("states, actions", (states, actions), "must be >= 1")
    needed: Floats = (states * actions) ** 3.3 / ((1.0 - gamma) ** 5.2 * size**2.6)
    return needed


def _columns(weights: Floats, change: Floats, error: Floats) -> tuple[Floats, Floats, Floats]:
    w, u, eps = (np.asarray(column, np.float64) for column in (weights, change, error))
    if w.ndim != 1 or not len(w):
        raise ConfigError("weights.shape", w.shape, "must be [l_p] with l_p >= 1")
    for name, column in (("change", u), ("error", eps)):
        if column.shape != w.shape:
            raise ConfigError(f"{name}.shape", column.shape, f"must be that of the weights, {w.shape}")
        if not (column >= 0).all():
            raise ConfigError(name, column.tolist(), "must be >= 0")
    return w, u, eps


def _size(value: float) -> float:
    if not 0.0 <= value < math.inf:
        raise ConfigError("q_max or u_max", value, "must be >= 0 and finite")
    return value
