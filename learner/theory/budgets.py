"""How much a world changes: variation budgets (paper, section 3, "Time elapsing variation budget").

b[t] is the change from unit t to t + 1, so a world of T units has T - 1 of them. With `local` and the
two cumulative budgets every bound of the paper can be written down.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from learner.theory.mdp import Floats, TimeElapsingMdp
from rtcore.config import ConfigError


class Budget(NamedTuple):
    """One kind of budget for rewards and for transitions."""

    reward: float
    transition: float


def reward_changes(world: TimeElapsingMdp) -> Floats:
    """b_r[t] = max_{s,a} |R_{t+1}(s, a) - R_t(s, a)|, [T - 1]."""
    changes: Floats = np.abs(np.diff(world.reward, axis=0)).max(axis=(1, 2))
    return changes


def transition_changes(world: TimeElapsingMdp) -> Floats:
    """b_p[t] = max_{s,a} ||P_{t+1}(.|s, a) - P_t(.|s, a)||_1, [T - 1]; each at most 2."""
    changes: Floats = np.abs(np.diff(world.transition, axis=0)).sum(-1).max(axis=(1, 2))
    return changes


def local(changes: Floats, begin: int, end: int) -> float:
    """B(t1, t2) = sum_{t=t1}^{t2-1} b[t]; 0 for t1 = t2.

    Raises:
        ConfigError: not 0 <= t1 <= t2 <= len(b), or `changes` are not [T - 1] numbers >= 0.
    """
    _check(changes, begin, end, beyond=0)
    return float(changes[begin:end].sum())


def cumulative(changes: Floats, begin: int, end: int) -> float:
    """Bbar(t1, t2) = sum_{t=t1}^{t2-1} B(t1, t) = sum_k (t2 - 1 - k) b[k], anchored at t1, as printed.

    The change b[t2-1] at the window's end is in no term.

    Raises:
        ConfigError: not 0 <= t1 <= t2 <= len(b) + 1, or `changes` as in `local`.
    """
    _check(changes, begin, end, beyond=1)
    inside = changes[begin : max(begin, end - 1)]
    return float((inside * np.arange(len(inside), 0, -1)).sum())


def cumulative_right(changes: Floats, begin: int, end: int) -> float:
    """sum_{t=t1}^{t2-1} B(t, t2 - 1) = sum_k (k - t1 + 1) b[k], anchored at t2 - 1.

    The proof of Lemma 1 compares every unit of the update phase with its last one, so this is what it
    sums; its statement has Bbar(t1, t2) instead, which is less when changes come late in the phase.

    Raises:
        ConfigError: not 0 <= t1 <= t2 <= len(b) + 1, or `changes` as in `local`.
    """
    _check(changes, begin, end, beyond=1)
    inside = changes[begin : max(begin, end - 1)]
    return float((inside * np.arange(1, len(inside) + 1)).sum())


def _check(changes: Floats, begin: int, end: int, *, beyond: int) -> None:
    if np.ndim(changes) != 1:
        raise ConfigError("changes.shape", np.shape(changes), "must be [T - 1]")
    if not (np.asarray(changes) >= 0).all():
        raise ConfigError("changes", np.asarray(changes).tolist(), "must be >= 0")
    limit = len(changes) + beyond
    if not 0 <= begin <= end <= limit:
        raise ConfigError("interval", (begin, end), f"must have 0 <= begin <= end <= {limit}")
