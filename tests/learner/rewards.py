"""Transitions whose reward is of the declared family, for the tests of reward models."""

from __future__ import annotations

from typing import Any

import numpy as np

from learner.replay import Replay
from rtcore.config import RewardConfig
from rtcore.spaces import Spaces
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM

FAMILY = RewardConfig(k_f=2.0, control_cost=0.1, healthy=3.0)
SPEED = 1  # the observation's entry
SPACES = Spaces(OBSERVATION_DIM, ACTION_DIM, action_low=(-2.0, -1.0), action_high=(6.0, 1.0))
PER_UNIT = 40


def pay(next_observation: Any, action: Any, z: float) -> Any:
    """The family by itself, the actions of SPACES written out: 2 + 4 a_0 and a_1."""
    cost = (2.0 + 4.0 * action[..., 0]) ** 2 + action[..., 1] ** 2
    return 3.0 - abs(2.0 * next_observation[..., SPEED] - z) - 0.1 * cost


class Stage:
    """A replay that is filled unit by unit, with rewards of a given z."""

    def __init__(self, seed: int = 1) -> None:
        self.replay = Replay(2000, OBSERVATION_DIM, ACTION_DIM)
        self._rng = np.random.default_rng(seed)

    def live(self, unit: int, z: float, count: int = PER_UNIT) -> None:
        for _ in range(count):
            observation, following = self._rng.standard_normal((2, OBSERVATION_DIM), np.float32)
            action = self._rng.uniform(-1, 1, ACTION_DIM).astype(np.float32)
            self.replay.add(observation, action, float(pay(following, action, z)), following, False, unit)
