"""The point mass against its equations."""

from __future__ import annotations

import numpy as np
import pytest

from env_server.worlds.drift import make_drift
from env_server.worlds.pointmass import PointMass
from rtcore.config import DriftConfig, RewardConfig
from tests.env_server.every_world import NONE, SINE


def test_pointmass_by_hand() -> None:
    drift = DriftConfig(kind="constant", offset=1.0)
    world = PointMass(drift, RewardConfig(control_cost=0.01), seed=0)
    noise = np.random.default_rng(11)
    speed = noise.uniform(-0.1, 0.1)
    assert world.reset(11, 0) == pytest.approx([speed])
    position = 0.0
    for action in (1.0, -0.5):
        speed = 0.8 * speed + 0.5 * action + 0.05 * noise.standard_normal()
        position += 0.05 * speed
        outcome = world.step(np.array([action], np.float32), 0)
        assert outcome.observation == pytest.approx([speed])
        assert outcome.reward == pytest.approx(-abs(speed - 1.0) - 0.01 * action**2)
        assert world.position() == pytest.approx([position])


def test_pointmass_settles_where_the_equation_says() -> None:
    # v = 0.8 v + 0.5 a has the fixed point 2.5 a; noise of sd 0.05 / sqrt(1 - 0.64) = 0.083
    world = PointMass(NONE, RewardConfig(), seed=0)
    world.reset(0, 0)
    speeds = [float(world.step(np.array([0.4], np.float32), 0).observation[0]) for _ in range(2000)]
    assert np.mean(speeds[100:]) == pytest.approx(1.0, abs=0.03)
    assert np.std(speeds[100:]) == pytest.approx(0.0833, abs=0.01)


def test_pointmass_with_two_periods_per_tick_is_the_one_period_world_twice() -> None:
    one = PointMass(SINE, RewardConfig(control_cost=0.0), seed=0)
    two = PointMass(SINE, RewardConfig(control_cost=0.0), seed=0, steps=2)
    one.reset(3, 0)
    two.reset(3, 0)
    action = np.array([0.7], np.float32)
    speeds = [one.step(action, 6).observation[0] for _ in range(2)]
    outcome = two.step(action, 6)
    assert outcome.observation[0] == speeds[1]
    assert two.position() == pytest.approx(one.position())
    assert outcome.reward == pytest.approx(-abs((speeds[0] + speeds[1]) / 2 - make_drift(SINE, 0).value(6)))
