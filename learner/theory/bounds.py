"""The bounds on dynamic regret as formulas: the paper's C_1 .. C_5, Lemmas 1 and 2 and Theorem 1.

Numbers in, terms out; `learner.theory.certificates` puts in those of a known world. x = eta tau throughout.

The paper's Theorem 1 does not hold as printed. What is wrong with it, and what is done here:

a. C_5 lacks r_max on its first term, which the equation it comes from has.
b. Lemma 1 has budgets anchored at t_m; its proof sums budgets anchored at t_m + G - 1.
c. The error delta^f is against Q* at t_{m+1}, and C_1 is of t_m, but the convergence of the policy
   gradient is used in the MDPs of t_m + G - 1 (Lemma 1) and t_m + G (Lemma 2): the anchors.
d. The end of Lemma 1's proof has Bbar_r for Bbar_p, and ends at t_m + G - 1 for t_m + G: misprints there.
e. Convergence gives (1 - x)^(g-1) for pi^g with g >= 1, and nothing for pi^0; both lemmas have (1 - x)^g.
f. Convergence is of steps towards Q of the present policy with entropy. Algorithm 1 makes all steps of a
   window towards one forecast of Q* without.
g. Convergence is of infinite episodes. C_1 and delta are of these here, and a world of finite ones needs
   2 gamma^H r_max / (1 - gamma) more per unit.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from learner.theory.budgets import Budget
from learner.theory.mdp import Floats, discounted_index, discounted_steps
from rtcore.config import ConfigError


class Constants(NamedTuple):
    """What of Lemma 1's constants does not depend on the policy, with x = eta tau."""

    x: float
    c2: float
    c3: float
    c4: float
    c5: float


class Start(NamedTuple):
    """How far pi_{t_m} is from the best regularised policy of one MDP.

    Attributes:
        value: ||Q*_tau - Q_tau^{pi_{t_m}}||_inf, in units of reward.
        log_policy: ||log pi*_tau - log pi_{t_m}||_inf, in nats.
    """

    value: float
    log_policy: float


class Terms(NamedTuple):
    """A bound on a window's regret, in the parts of Theorem 1.

    Attributes:
        policy: R^pi, what is left of pi_{t_m}.
        forecast: R^f, the forecast's error and the entropy.
        environment: R^env, what changed.
        tail: what the horizon may add; 0 for infinite episodes.
    """

    policy: float
    forecast: float
    environment: float
    tail: float = 0.0

    @property
    def total(self) -> float:
        """The bound."""
        return self.policy + self.forecast + self.environment + self.tail

    def plus(self, other: Terms) -> Terms:
        """The sum, term by term."""
        return Terms(*(mine + its for mine, its in zip(self, other, strict=True)))


def constants(
    *,
    gamma: float,
    eta: float,
    tau: float,
    actions: int,
    r_max: float,
    horizon: int | None = None,
    printed: bool = False,
) -> Constants:
    """C_2 .. C_5 of Lemma 1.

        C_2 = 2 (gamma + 2) / (1 - gamma) (1 + gamma / x)     C_3 = 2 tau log|A| / (1 - gamma)
        C_4 = 2 h                                             C_5 = k r_max + h r_max / (1 - gamma)

    with h and k of `discounted_steps` and `discounted_index`. Printed, C_5 = k + h r_max / (1 - gamma): its
    first term comes from the last lemma of the paper's appendix, which loses the r_max of its own equation.

    Raises:
        ConfigError: gamma, horizon, tau, actions or r_max that cannot be, or eta outside
            (0, (1 - gamma) / tau], a condition of the convergence that the paper does not state.
    """
    h, k = discounted_steps(gamma, horizon), discounted_index(gamma, horizon)
    x = check_rate(eta, tau, gamma) * tau
    if actions < 1:
        raise ConfigError("actions", actions, "must be >= 1")
    if not 0.0 <= r_max < math.inf:
        raise ConfigError("r_max", r_max, "must be >= 0 and finite")
    return Constants(
        x=x,
        c2=2.0 * (gamma + 2.0) / (1.0 - gamma) * (1.0 + gamma / x),
        c3=2.0 * tau * math.log(actions) / (1.0 - gamma),
        c4=2.0 * h,
        c5=k * (1.0 if printed else r_max) + h * r_max / (1.0 - gamma),
    )


def check_rate(eta: float, tau: float, gamma: float) -> float:
    """`eta`, if the policy gradient converges with it.

    Raises:
        ConfigError: tau <= 0, or eta outside (0, (1 - gamma) / tau].
    """
    if not 0.0 < tau < math.inf:
        raise ConfigError("tau", tau, "must be > 0 and finite")
    most = (1.0 - gamma) / tau
    if not 0.0 < eta <= most * (1.0 + 1e-9):  # a hair above is the rounding of eta = (1 - gamma) / tau
        raise ConfigError("eta", eta, f"must be in (0, (1 - gamma) / tau] = (0, {most:g}]")
    return min(eta, most)


def c1(start: Start, *, gamma: float, eta: float, tau: float) -> float:
    """C_1 = (gamma + 2) (||Q*_tau - Q_tau^pi|| + 2 tau (1 - x / (1 - gamma)) ||log pi*_tau - log pi||).

    The paper's bracket closes around the norm, which can make C_1 negative; Cen et al. (2022), theorem 2,
    have it as here.
    """
    rate = check_rate(eta, tau, gamma)
    kept = max(0.0, 1.0 - rate * tau / (1.0 - gamma))
    return (gamma + 2.0) * (start.value + 2.0 * tau * kept * start.log_policy)


def update_bound(found: Constants, c1: float, delta: float, budget: Budget, update: int) -> Terms:
    """Lemma 1: C_1 (1 - (1 - x)^G) / x + G (C_2 delta + C_3) + C_4 Bbar_r + C_5 Bbar_p.

    Args:
        found: the constants.
        c1: C_1; printed of M_{t_m}, repaired of M_{t_m+G-1}.
        delta: error of the forecast; printed against Q* at t_{m+1}, repaired at t_m + G - 1.
        budget: of [t_m, t_m + G); printed `budgets.cumulative`, repaired `budgets.cumulative_right`.
        update: G >= 0.
    """
    _check_units("update", update, 0)
    left = (1.0 - found.x) ** update
    return Terms(c1 * (1.0 - left) / found.x, _forecast(found, delta, update), _environment(found, budget))


def hold_bound(found: Constants, c1: float, delta: float, budget: Budget, update: int, hold: int) -> Terms:
    """Lemma 2: N (C_1 (1 - x)^G + C_2 delta + C_3) + C_4 Bbar_r + C_5 Bbar_p.

    Args:
        found: the constants.
        c1: C_1; printed of M_{t_m}, repaired of M_{t_m+G}.
        delta: error of the forecast; printed against Q* at t_{m+1}, repaired at t_m + G.
        budget: `budgets.cumulative` of [t_m + G, t_{m+1}): here the proof is anchored on the left as well.
        update: G >= 0.
        hold: N >= 0.
    """
    _check_units("update", update, 0)
    _check_units("hold", hold, 0)
    left = (1.0 - found.x) ** update
    return Terms(hold * c1 * left, _forecast(found, delta, hold), _environment(found, budget))


def theorem1(found: Constants, c1: float, delta: float, budget: Budget, update: int, hold: int) -> Terms:
    """One window of Theorem 1: C_1 / x + (N C_1 - C_1 / x) (1 - x)^G, (N + G) (C_2 delta + C_3), Bbar.

    `budget` is the sum over both phases. With one C_1 and one delta this is Lemma 1 plus Lemma 2.
    """
    _check_units("update", update, 0)
    _check_units("hold", hold, 0)
    once = c1 / found.x
    policy = once + (hold * c1 - once) * (1.0 - found.x) ** update
    return Terms(policy, _forecast(found, delta, update + hold), _environment(found, budget))


def settled_update_bound(
    found: Constants, start: Start, c1: float, delta: float, budget: Budget, update: int, tau: float
) -> Terms:
    """Lemma 1 with the exponents that convergence has (e): R^pi = C_0 + C_1 (1 - (1 - x)^(G-1)) / x, G >= 1.

    C_0 = ||Q*_tau - Q_tau|| + tau ||log pi*_tau - log pi_{t_m}|| bounds what pi^0 itself loses to V*_tau, and
    C_1 (1 - x)^(g-1) what pi^g does. All else is as in `update_bound`.
    """
    _check_units("update", update, 1)
    after = update_bound(found, c1, delta, budget, update - 1)
    c0 = start.value + tau * start.log_policy
    return after._replace(policy=c0 + after.policy, forecast=_forecast(found, delta, update))


def settled_hold_bound(
    found: Constants, c1: float, delta: float, budget: Budget, update: int, hold: int
) -> Terms:
    """Lemma 2 likewise: R^pi = N C_1 (1 - x)^(G-1), G >= 1."""
    _check_units("update", update, 1)
    return hold_bound(found, c1, delta, budget, update - 1, hold)


def optimal_gap(gamma: float, r_max: float, budget: Budget, horizon: int | None = None) -> float:
    """The paper's bound on ||Q*_{t1} - Q*_{t2}||, and on V*: h (B_r + r_max / (1 - gamma) B_p)."""
    h = discounted_steps(gamma, horizon)
    return h * (budget.reward + r_max / (1.0 - gamma) * budget.transition)


def same_policy_gap(
    gamma: float, r_max: float, budget: Budget, horizon: int | None = None, *, printed: bool = False
) -> float:
    """The paper's bound on V^pi_{t1} - V^pi_{t2}: h B_r + k r_max B_p; printed without the r_max."""
    h, k = discounted_steps(gamma, horizon), discounted_index(gamma, horizon)
    return h * budget.reward + k * (1.0 if printed else r_max) * budget.transition


def gibbs_bound(
    delta: Floats | float,
    step: NDArray[Any],
    surprise: Floats | float,
    *,
    gamma: float,
    eta: float,
    tau: float,
    actions: int,
) -> Floats:
    """What pi^g can lose in any MDP, g >= 1, from one fixed forecast: a replacement of Theorem 1.

        V* - V^{pi^g} <= (2 delta + tau / (1 - beta^g) (log|A| + beta^g surprise)) / (1 - gamma)

    with beta = 1 - eta tau / (1 - gamma). pi^g is proportional to exp(f), f = beta^g log pi_0 +
    (1 - beta^g) Qtilde / tau, and so has the largest mean of f plus entropy (Gibbs). Compare it with the
    policy that plays a*, and use the performance-difference lemma (Kakade and Langford, 2002).

    The last part falls with g and the first does not depend on it. So, for a window and a policy that
    it begins with, this bound is least with N = 0, whatever changes: the positive holds that minimise
    Theorem 1's come from its two anchors, one per phase.

    Args:
        delta: ||Qtilde - Q*||_inf in that MDP; any shape.
        step: g >= 1, likewise.
        surprise: max_s -log pi_0(a*(s)|s), a* a best action in that MDP; likewise.
        gamma: discount per step.
        eta: learning rate, in (0, (1 - gamma) / tau].
        tau: weight of the entropy.
        actions: |A|.
    """
    rate = check_rate(eta, tau, gamma)
    if not (np.asarray(step) >= 1).all():
        raise ConfigError("step", np.asarray(step).tolist(), "must be >= 1")
    left = max(0.0, 1.0 - rate * tau / (1.0 - gamma)) ** np.asarray(step, np.float64)
    softness = tau / (1.0 - left) * (math.log(actions) + left * surprise)
    bound: Floats = (2.0 * delta + softness) / (1.0 - gamma)
    return bound


def _check_units(name: str, units: int, least: int) -> None:
    if units < least:
        raise ConfigError(name, units, f"must be >= {least}: units of a phase")


def _forecast(found: Constants, delta: float, units: int) -> float:
    if not delta >= 0:
        raise ConfigError("delta", delta, "must be >= 0")
    return units * (found.c2 * delta + found.c3)


def _environment(found: Constants, budget: Budget) -> float:
    return found.c4 * budget.reward + found.c5 * budget.transition
