"""The schedule `auto_bound`: how to split a window so that Theorem 1, with live estimates in it, is least."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learner.tabular.table import log_normalised
from learner.theory import bounds
from learner.theory.bounds import Start, Terms
from learner.theory.budgets import Budget
from learner.theory.optimum import TIE

Floats = NDArray[np.float64]
Index = NDArray[np.int64]


def bound_choice(
    log_policy: Floats,
    forecast: Floats,
    slope: Floats,
    *,
    window: int,
    eta: float,
    tau: float,
    gamma: float,
) -> Index:
    """The G = W - N in 1 .. W of the least R^pi + R^env of Theorem 1, for rewards that change steadily.

        U(N) = C_1 (1 - (1 - x)^G) / x + N C_1 (1 - x)^G + C_4 b_r (G (G - 1) + N (N - 1)) / 2

    with x = eta tau. Its b_r is the change of Q per unit, scaled to that of a reward which is seen for ever:
    (1 - gamma) ||slope||_inf. A cumulative budget of n units that change by b_r each is b_r n (n - 1) / 2.
    R^f is the same for every N. Transitions are taken not to change: tables alone do not tell what does.

    Args:
        log_policy: log pi_{t_m}, [..., S, A], finite.
        forecast: Qtilde, [..., S, A], which C_1 takes for Q*_tau.
        slope: of the past tables per unit, [..., S, A].
        window: W >= 1, units.
        eta: learning rate, in (0, (1 - gamma) / tau].
        tau: weight of the entropy, > 0, in units of reward.
        gamma: discount per step.

    Returns:
        G, [...]; of equally good ones the largest, the least hold.

    Raises:
        ConfigError: an eta, a tau or a gamma out of its range.
    """
    value, distance = start_distances(log_policy, forecast, tau=tau, gamma=gamma)
    # C_1 is linear in both distances, and U in C_1 and b_r: what each of them is multiplied by
    of_value, of_distance = (
        bounds.c1(unit, gamma=gamma, eta=eta, tau=tau) for unit in (Start(1, 0), Start(0, 1))
    )
    c1 = of_value * value + of_distance * distance
    steepest = np.abs(slope).max((-2, -1))
    steepest = np.where(steepest > TIE * np.abs(forecast).max((-2, -1)), steepest, 0.0)  # less is rounding
    change = (1.0 - gamma) * steepest
    found = bounds.constants(gamma=gamma, eta=eta, tau=tau, actions=slope.shape[-1], r_max=1.0)

    def terms(hold: int) -> Terms:
        update = window - hold
        steady = Budget((update * (update - 1) + hold * (hold - 1)) / 2, 0.0)
        return bounds.theorem1(found, 1.0, 0.0, steady, update, hold)

    split = [terms(hold) for hold in range(window)]
    bound = np.multiply.outer([one.policy for one in split], c1)
    bound += np.multiply.outer([one.environment for one in split], change)
    hold: Index = (bound <= bound.min(0) * (1.0 + TIE)).argmax(0)  # N = 0 and 1 tie where nothing changes
    return window - hold


def start_distances(
    log_policy: Floats, forecast: Floats, *, tau: float, gamma: float
) -> tuple[Floats, Floats]:
    """The two distances in C_1, with `forecast` for Q*_tau: a bound on the first, and the second, [...].

        ||Q*_tau - Q_tau^pi||_inf <= gamma tau / (1 - gamma) max_s KL(pi(.|s) || pi*(.|s))
        ||log pi*_tau - log pi||_inf,    pi* = softmax(Q*_tau / tau)

    The value of pi is not known without a model. V*_tau - V_tau^pi is the discounted sum of tau KL over the
    states that pi visits (Mei et al., 2020, "On the global convergence rates of softmax policy gradient
    methods", the soft sub-optimality lemma), and these are not known either.
    """
    apart = log_policy - log_normalised(forecast / tau)
    divergence = (np.exp(log_policy) * apart).sum(-1).max(-1)
    return gamma * tau / (1.0 - gamma) * divergence, np.abs(apart).max((-2, -1))
