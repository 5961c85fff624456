"""The reward of the worlds with a drifting target speed. Pure."""

from __future__ import annotations

import numpy as np

from env_server.worlds.world import Vector
from rtcore.config import RewardConfig


def speed_reward(config: RewardConfig, *, speed: float, target: float, action: Vector) -> float:
    """Reward of one step (paper, appendix, environments).

        r = healthy - |k_f v - v_d(t)| - control_cost |a|^2

    The paper adds a healthy reward without a value; Gymnasium has none for HalfCheetah and Swimmer,
    so it is 0 unless configured.

    Args:
        config: the three weights.
        speed: v, mean forward speed over the step in m per simulated second.
        target: v_d(t), in the units of k_f v.
        action: float32 [n], in the world's units.
    """
    wide = action.astype(np.float64)
    return config.healthy - abs(config.k_f * speed - target) - config.control_cost * float(wide @ wide)
