"""Policies of finite worlds: a state's number in, an action's number out. Both are one float32."""

from __future__ import annotations

import numpy as np

from agent_service.inference import Array

DRAWS = 64  # random numbers at a time: one by one they cost 0.4 us each, 64 at once 0.7 us


class UniformChoice:
    """pi_0: each action as likely as any other, whatever is observed."""

    version = 0

    def __init__(self, actions: int) -> None:
        self._actions = actions
        self._action = np.zeros(1, np.float32)

    def act(self, observation: Array, rng: np.random.Generator) -> Array:
        """Draw an action's number, float32 [1]."""
        del observation
        self._action[0] = rng.integers(self._actions)
        return self._action


class CategoricalPolicy:
    """A probability for each action in each state."""

    def __init__(self, version: int, probability: Array) -> None:
        """`probability`: float32 [states, actions], rows that sum to 1."""
        self.version = version
        sums = np.cumsum(probability, axis=1, dtype=np.float64)
        # Divided by its last entry a row ends at 1 exactly, and every draw is below that: so no rounding
        # lets an action act whose probability is 0.
        self._thresholds = sums[:, :-1] / sums[:, -1:]
        self._draws = np.zeros(DRAWS)
        self._next = DRAWS
        self._action = np.zeros(1, np.float32)

    def act(self, observation: Array, rng: np.random.Generator) -> Array:
        """Draw an action's number, float32 [1]. `observation` is a state's, float32 [1]."""
        if self._next == DRAWS:
            rng.random(out=self._draws)
            self._next = 0
        thresholds = self._thresholds[int(observation[0])]
        self._action[0] = thresholds.searchsorted(self._draws[self._next], side="right")
        self._next += 1
        return self._action
