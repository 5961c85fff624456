from __future__ import annotations

import numpy as np
import pytest

from env_server.worlds.reward import speed_reward
from rtcore.config import RewardConfig


@pytest.mark.parametrize(
    ("config", "speed", "target", "action", "expected"),
    [
        (RewardConfig(control_cost=0.0), 1.0, 1.0, [0.0, 0.0], 0.0),
        (RewardConfig(control_cost=0.0), 1.5, 1.0, [0.0, 0.0], -0.5),
        (RewardConfig(control_cost=0.0), -1.5, 1.0, [1.0, 1.0], -2.5),
        (RewardConfig(control_cost=0.1), 1.0, 1.0, [0.5, -1.0], -0.125),  # 0.1 * (0.25 + 1)
        (RewardConfig(k_f=2.0, control_cost=0.0, healthy=0.25), 1.0, 0.5, [0.0, 0.0], -1.25),
    ],
)
def test_by_hand(
    config: RewardConfig, speed: float, target: float, action: list[float], expected: float
) -> None:
    reward = speed_reward(config, speed=speed, target=target, action=np.array(action, np.float32))
    assert reward == pytest.approx(expected, abs=1e-12)
