"""Factors on mass, friction and gravity: what they do to a point and to MuJoCo."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from env_server.worlds.gym_world import GymWorld
from env_server.worlds.mujoco_physics import ModelPhysics
from env_server.worlds.physics import LEAST_MASS, Factors, Physics
from env_server.worlds.pointmass import PointMass
from rtcore.config import DriftConfig, PhysicsConfig, RewardConfig

NONE = DriftConfig(kind="none")


def switched(at: int, value: float) -> DriftConfig:
    """1 before unit `at`, `value` from then on."""
    return DriftConfig(kind="switch", offset=1.0, amplitude=value - 1.0, at=at)


def model_of(env_id: str = "HalfCheetah-v5") -> tuple[Any, Any]:
    world = GymWorld(env_id, seed=0)
    world.reset(0, 0)
    inner: Any = world._inner
    return inner.model, inner.data


def test_factors_are_one_unless_they_drift() -> None:
    physics = Physics(PhysicsConfig(friction=switched(2, 0.5)), 0)
    assert [physics.factors(t) for t in (0, 2)] == [Factors(1, 1, 1), Factors(1, 0.5, 1)]
    assert [physics.told(t) for t in (0, 2)] == [(1, 1, 1), (1, 0.5, 1)]
    assert Physics(PhysicsConfig(), 0).told(3) == ()


def test_random_factors_are_stopped_and_move_apart() -> None:
    walk = DriftConfig(kind="noise", offset=0.5, sd=1.0)
    physics = Physics(PhysicsConfig(mass=walk, friction=walk, gravity=walk), 0)
    found = np.array([physics.factors(t) for t in range(200)])
    assert found.min(axis=0).tolist() == [LEAST_MASS, 0.0, 0.0]
    assert len({tuple(column) for column in found.T.round(12)}) == 3


def test_a_point_by_hand() -> None:
    # mass 2 halves the gain to 0.25, friction 1.5 makes the decay 1 - 0.2 * 1.5 = 0.7, from unit 1 on
    physics = Physics(PhysicsConfig(mass=switched(1, 2.0), friction=switched(1, 1.5)), 0)
    world = PointMass(NONE, RewardConfig(), seed=0, physics=physics)
    noise = np.random.default_rng(11)
    speed = noise.uniform(-0.1, 0.1)
    world.reset(11, 0)
    for t, decay, gain in ((0, 0.8, 0.5), (1, 0.7, 0.25), (2, 0.7, 0.25), (0, 0.8, 0.5)):
        speed = decay * speed + gain * 0.6 + 0.05 * noise.standard_normal()
        assert world.step(np.array([0.6], np.float32), t).observation == pytest.approx([speed])


def test_a_point_under_huge_friction_stops_and_is_not_thrown_back() -> None:
    physics = Physics(PhysicsConfig(friction=DriftConfig(kind="constant", offset=50.0)), 0)
    world = PointMass(NONE, RewardConfig(), seed=0, physics=physics)
    world.reset(0, 0)
    speeds = [float(world.step(np.array([1.0], np.float32), 0).observation[0]) for _ in range(100)]
    assert np.mean(speeds) == pytest.approx(0.5, abs=0.05)  # the gain alone, and noise


def test_a_model_gets_the_factors_and_keeps_its_state() -> None:
    model, data = model_of()
    mass, inertia, friction = model.body_mass.copy(), model.body_inertia.copy(), model.geom_friction.copy()
    subtree, inverse = model.body_subtreemass.copy(), model.body_invweight0.copy()
    config = PhysicsConfig(mass=switched(1, 2.0), friction=switched(2, 0.5), gravity=switched(3, 0.25))
    tuned = ModelPhysics(model, Physics(config, 0))
    data.qvel[:] = np.arange(model.nv)
    state = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()

    tuned.apply(0)
    np.testing.assert_array_equal(model.body_mass, mass)
    tuned.apply(1)
    np.testing.assert_array_equal(model.body_mass, 2 * mass)
    np.testing.assert_array_equal(model.body_inertia, 2 * inertia)
    np.testing.assert_allclose(model.body_subtreemass, 2 * subtree)  # derived by MuJoCo
    assert (model.body_invweight0[1:] < inverse[1:]).all()  # so contacts know of it
    np.testing.assert_array_equal(model.geom_friction, friction)
    tuned.apply(3)
    np.testing.assert_array_equal(model.geom_friction, friction * [0.5, 1.0, 1.0])
    np.testing.assert_array_equal(model.opt.gravity, [0, 0, -9.81 / 4])
    for now, before in zip((data.qpos, data.qvel, data.qacc_warmstart), state, strict=True):
        np.testing.assert_array_equal(now, before)

    tuned.apply(0)  # and back, without a trace
    np.testing.assert_array_equal(model.body_mass, mass)
    np.testing.assert_array_equal(model.body_invweight0, inverse)
    np.testing.assert_array_equal(model.geom_friction, friction)


def test_a_body_in_the_air_falls_by_the_gravity_of_the_unit() -> None:
    config = PhysicsConfig(gravity=switched(1, 0.5), mass=switched(1, 3.0))
    world = GymWorld("HalfCheetah-v5", seed=0, frame_skip=1, physics=Physics(config, 0))
    inner: Any = world._inner
    falls = []
    for t in (0, 1):
        world.reset(0, t)
        inner.set_state(np.array([0.0, 5.0, *[0.0] * 7]), np.zeros(9))
        world.step(np.zeros(6, np.float32), t)
        falls.append(_velocity_up(inner) / 0.01)
    # free fall of the centre of mass, whatever its mass: g, and then g / 2
    assert falls == pytest.approx([-9.81, -9.81 / 2], rel=1e-3)
    world.close()


def _velocity_up(inner: Any) -> float:
    """Of the centre of mass, in m/s."""
    mujoco.mj_fwdPosition(inner.model, inner.data)
    mujoco.mj_fwdVelocity(inner.model, inner.data)
    mujoco.mj_subtreeVel(inner.model, inner.data)
    return float(inner.data.subtree_linvel[1][2])


def test_a_world_under_factors_of_one_is_the_world_without() -> None:
    one = DriftConfig(kind="constant", offset=1.0)
    physics = Physics(PhysicsConfig(mass=one, friction=one, gravity=one), 0)
    tuned = GymWorld("HalfCheetah-v5", seed=0, physics=physics)
    plain = GymWorld("HalfCheetah-v5", seed=0)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(tuned.reset(3, 0), plain.reset(3, 0))
    for t in range(20):
        action = rng.uniform(-1, 1, 6).astype(np.float32)
        np.testing.assert_array_equal(tuned.step(action, t).observation, plain.step(action, t).observation)
    tuned.close()
    plain.close()
