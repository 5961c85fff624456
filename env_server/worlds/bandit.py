"""The paper's motivating example (section 1): a Bernoulli bandit whose two arms swap their rewards."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from env_server.worlds.finite import FiniteWorld, Floats, Tables

ARMS = 2


def chance(drift: float, action: int) -> float:
    """P(reward = 1) of an arm: v for a_0 and 1 - v for a_1, where v is `drift` clipped to [0, 1].

    So a_1 pays while v = 0, as in the paper's R_0(a_1) = 1, and a_0 once the drift has gone to 1.
    """
    v = float(np.clip(drift, 0.0, 1.0))
    return v if action == 0 else 1.0 - v


class Bandit(FiniteWorld):
    """The `bandit` world: one state, two arms, a reward of 1 or 0. Its episodes have no end of their own."""

    def __init__(self, drift: Callable[[int], float], *, seed: int) -> None:
        """`drift` gives v in unit t; the rewards' draws come from `seed`."""
        super().__init__(states=1, actions=ARMS, drift=drift, seed=seed)

    def tables(self, t: int) -> Tables:
        """The mean rewards, and one state that leads to itself."""
        reward = np.array([[chance(self.drift(t), arm) for arm in range(ARMS)]])
        return Tables(reward, np.ones((1, ARMS, 1)))

    def starts(self) -> Floats:
        """The only state."""
        return np.ones(1)

    def start(self, _drift: float) -> int:
        """The only state."""
        return 0

    def transition(self, state: int, action: int, drift: float) -> tuple[int, float, bool]:
        """Draw the arm's reward."""
        paid = self.random.random() < chance(drift, action)  # in [0, 1): never for 0, always for 1
        return state, float(paid), False
