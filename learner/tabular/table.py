"""Equations on tables: Q-learning, the policies that a table stands for, and the policy gradient on it.

Pure functions on float64 arrays [..., S, A]: S states, A actions, any leading axes. What is before
the states are lanes that do not see each other, so that many seeds go through one call.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Table = NDArray[np.float64]  # [..., S, A]
Lane = NDArray[np.float64]  # [L]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]


def q_update(
    q: Table,
    state: Index,
    action: Index,
    reward: Lane,
    next_state: Index,
    terminated: Flags,
    *,
    step_size: float | Lane,
    gamma: float,
) -> Lane:
    """One transition of each lane, learned into `q` in place.

        Q(s, a) <- Q(s, a) + alpha delta,    delta = r + gamma (1 - terminated) max_a' Q(s', a') - Q(s, a)

    Source: Watkins and Dayan (1992), "Q-learning".

    Args:
        q: [L, S, A].
        state: [L], numbers from 0.
        action: [L], likewise.
        reward: [L], per tick.
        next_state: [L], where the action led.
        terminated: [L]; a truncated transition is not terminated.
        step_size: alpha, for all lanes or [L].
        gamma: discount per tick, in [0, 1].

    Returns:
        delta, [L], before the update.
    """
    assert q.ndim == 3 and len(q) == len(state) == len(action), "q must be [L, S, A], with L transitions"
    lane = np.arange(len(q))
    following = np.where(terminated, 0.0, q[lane, next_state].max(axis=-1))
    delta: Lane = reward + gamma * following - q[lane, state, action]
    q[lane, state, action] += step_size * delta
    return delta


def greedy(q: Table) -> Index:
    """argmax_a Q(s, a), [..., S]; the first of equals."""
    best: Index = q.argmax(axis=-1)
    return best


def epsilon_greedy(q: Table, epsilon: float) -> Table:
    """Probabilities [..., S, A]: 1 - epsilon on the greedy action, and epsilon / A on each.

    Source: Sutton and Barto (2018), section 2.4.
    """
    best = np.arange(q.shape[-1]) == greedy(q)[..., None]
    return mix(best.astype(np.float64), epsilon)


def mix(probabilities: Table, epsilon: float) -> Table:
    """(1 - epsilon) pi + epsilon / A: a share of uniformly random actions on top of the policy pi."""
    assert 0 <= epsilon <= 1, "epsilon must be in [0, 1]"
    mixed: Table = (1.0 - epsilon) * probabilities + epsilon / probabilities.shape[-1]
    return mixed


def npg_step(log_policy: Table, q: Table, *, eta: float, entropy: float, gamma: float) -> Table:
    """One step of the natural policy gradient with entropy, for a softmax policy over a table.

        log pi'(a|s) = (1 - eta tau / (1 - gamma)) log pi(a|s) + eta Q(s, a) / (1 - gamma) - log Z(s)

    Z(s) makes the probabilities of a state sum to 1. With the same Q in every step the policy goes to
    softmax(Q / tau); the step is one towards it as long as eta <= (1 - gamma) / tau.

    Source: Cen et al. (2022), "Fast global convergence of natural policy gradient methods with entropy
    regularization", for Q of the policy itself; the paper's Algorithm 1 puts the forecast in its place.

    Args:
        log_policy: log pi, [..., S, A].
        q: [..., S, A].
        eta: learning rate, > 0.
        entropy: tau, >= 0, in units of reward.
        gamma: discount per tick, in [0, 1).

    Returns:
        log pi', [..., S, A].
    """
    assert 0 <= gamma < 1, "gamma must be in [0, 1)"
    # a hair above 1 is the rounding of eta = (1 - gamma) / tau
    assert eta > 0 and eta * entropy <= (1 - gamma) * (1 + 1e-9), "eta must be in (0, (1 - gamma) / tau]"
    kept = max(0.0, 1.0 - eta * entropy / (1.0 - gamma))
    return log_normalised(kept * log_policy + eta / (1.0 - gamma) * q)


def log_normalised(scores: Table) -> Table:
    """The logarithm of softmax(scores) over the actions, [..., S, A]; scores may be large."""
    raised = scores - scores.max(axis=-1, keepdims=True)
    shifted: Table = raised - np.log(np.exp(raised).sum(axis=-1, keepdims=True))
    return shifted
