"""Exact values of finite MDPs, plain and regularised by entropy.

Every function takes R [..., S, A] and P [..., S, A, S] with any leading axes, such as the units of a
time-elapsing MDP, and returns arrays with the same ones. What is the same in all of them is not copied.
What has no value is refused with a ConfigError: gamma outside [0, 1), H < 1, tau <= 0, a row of P that is no
distribution, numbers that are not finite, shapes that do not fit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from learner.tabular.table import log_normalised
from learner.theory.mdp import Floats, check_discount, check_distributions
from rtcore.config import ConfigError

# Improvements below this share of the largest value are rounding: policy iteration would follow them in
# circles between actions that are equally good.
_ROUNDING = 1e-12
_SETTLED = 1e-11  # likewise, of a step of soft policy iteration
_MOST_STEPS = 1000


class Values(NamedTuple):
    """Q(s, a), [..., S, A], and V(s), [..., S], in units of reward."""

    q: Floats
    v: Floats


class SoftOptimum(NamedTuple):
    """Q*_tau [..., S, A], V*_tau [..., S], log pi*_tau [..., S, A]."""

    q: Floats
    v: Floats
    log_policy: Floats


def evaluate(
    reward: Floats, transition: Floats, policy: Floats, *, gamma: float, horizon: int | None = None
) -> Values:
    """Q^pi and V^pi of a policy pi(a|s), [..., S, A], that is the same in every step.

    With H = None, V^pi solves (I - gamma P^pi) V = R^pi; otherwise H steps of backward induction.

    Source: Puterman (1994), sections 4.2 and 6.1.
    """
    check_discount(gamma, horizon)
    _check_mdp(reward, transition)
    _check_table("policy", policy, reward.shape[-2:])
    if horizon is None:
        return _evaluate(reward, transition, policy, gamma)
    q, v = reward, np.zeros(np.broadcast_shapes(reward.shape, policy.shape)[:-1])
    for _ in range(horizon):
        q = backup(reward, transition, v, gamma)
        v = (policy * q).sum(-1)
    return Values(q, v)


def optimal(reward: Floats, transition: Floats, *, gamma: float, horizon: int | None = None) -> Values:
    """Q* and V*. With H = None by policy iteration; otherwise over policies that may depend on the step.

    Source: Puterman (1994), sections 4.3 and 6.4.
    """
    check_discount(gamma, horizon)
    _check_mdp(reward, transition)
    if horizon is None:
        return _policy_iteration(reward, transition, gamma)
    q, v = reward, np.zeros(reward.shape[:-1])
    for _ in range(horizon):
        q = backup(reward, transition, v, gamma)
        v = q.max(-1)
    return Values(q, v)


def soft_evaluate(
    reward: Floats, transition: Floats, log_policy: Floats, *, gamma: float, tau: float
) -> Values:
    """Q^pi_tau and V^pi_tau, infinite horizon, of a policy given by log pi(a|s), [..., S, A], finite.

        V_tau = sum_a pi (Q_tau - tau log pi),    Q_tau = R + gamma P V_tau

    Source: Cen et al. (2022), equations 3 to 5.
    """
    check_discount(gamma, None)
    _check_entropy(tau)
    _check_mdp(reward, transition)
    _check_table("log_policy", log_policy, reward.shape[-2:])
    return _soft_evaluate(reward, transition, log_policy, gamma, tau)


def soft_optimal(reward: Floats, transition: Floats, *, gamma: float, tau: float) -> SoftOptimum:
    """Q*_tau, V*_tau and pi*_tau = softmax(Q*_tau / tau), infinite horizon, by soft policy iteration.

    That is Newton's method on the soft Bellman equation, which is convex: it cannot overshoot.

    Source: Nachum et al. (2017), section 3; Cen et al. (2022), equation 10.
    """
    check_discount(gamma, None)
    _check_entropy(tau)
    q = optimal(reward, transition, gamma=gamma).q
    for _ in range(_MOST_STEPS):
        before, log_policy = q, log_normalised(q / tau)
        q = _soft_evaluate(reward, transition, log_policy, gamma, tau).q
        if np.abs(q - before).max() <= _SETTLED * _size(q):
            break
    log_policy = log_normalised(q / tau)
    return SoftOptimum(q, tau * (q / tau - log_policy).mean(-1), log_policy)


def backup(reward: Floats, transition: Floats, v: Floats, gamma: float) -> Floats:
    """R + gamma P V, [..., S, A]."""
    q: Floats = reward + gamma * np.einsum("...sat,...t->...sa", transition, v)
    return q


def _evaluate(reward: Floats, transition: Floats, policy: Floats, gamma: float) -> Values:
    v = _solve(transition, policy, (policy * reward).sum(-1), gamma)
    return Values(backup(reward, transition, v, gamma), v)


def _soft_evaluate(
    reward: Floats, transition: Floats, log_policy: Floats, gamma: float, tau: float
) -> Values:
    policy = np.exp(log_policy)
    v = _solve(transition, policy, (policy * (reward - tau * log_policy)).sum(-1), gamma)
    return Values(backup(reward, transition, v, gamma), v)


def _solve(transition: Floats, policy: Floats, reward: Floats, gamma: float) -> Floats:
    """V of the Markov chain under `policy` that pays `reward` [..., S] per step."""
    moves = np.einsum("...sa,...sat->...st", policy, transition)
    v: Floats = np.linalg.solve(np.eye(moves.shape[-1]) - gamma * moves, reward[..., None])[..., 0]
    return v


def _policy_iteration(reward: Floats, transition: Floats, gamma: float) -> Values:
    action = reward.argmax(-1)
    while True:  # there are finitely many policies, and each is strictly better than the one before
        values = _evaluate(reward, transition, np.eye(reward.shape[-1])[action], gamma)
        kept = np.take_along_axis(values.q, action[..., None], -1)[..., 0]
        better = values.q.max(-1) > kept + _ROUNDING * _size(values.q)
        if not better.any():
            return Values(values.q, values.q.max(-1))
        action = np.where(better, values.q.argmax(-1), action)


def _size(values: Floats) -> float:
    return max(1.0, float(np.abs(values).max()))


def _check_mdp(reward: Floats, transition: Floats) -> None:
    """With rows that sum to more than 1 policy iteration need not end, and with NaN it would end at once."""
    if reward.ndim < 2 or not reward.size:
        raise ConfigError("reward.shape", reward.shape, "must be [..., S, A], none of them empty")
    states, actions = reward.shape[-2:]
    _check_table("reward", reward, (states, actions))
    if transition.shape[-3:] != (states, actions, states):
        allowed = f"must end with [S, A, S] = {(states, actions, states)}"
        raise ConfigError("transition.shape", transition.shape, allowed)
    check_distributions("transition", transition)


def _check_table(name: str, table: Floats, shape: tuple[int, ...]) -> None:
    if table.shape[-2:] != shape:
        raise ConfigError(f"{name}.shape", table.shape, f"must end with [S, A] = {shape}")
    if not np.isfinite(table).all():
        where = np.argwhere(~np.isfinite(table))[0].tolist()
        raise ConfigError(f"{name}{where}", float(table[tuple(where)]), "must be finite")


def _check_entropy(tau: float) -> None:
    if not tau > 0:
        raise ConfigError("tau", tau, "must be > 0")
