"""What every world keeps to, and what each one alone promises."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from env_server.worlds.drift import value
from env_server.worlds.pointmass import PointMass
from env_server.worlds.registry import make_world
from env_server.worlds.world import Outcome, Vector, World
from rtcore.config import DriftConfig, EnvConfig, RewardConfig

SINE = DriftConfig(kind="sine", offset=0.5, amplitude=1.0, omega=0.3)
NONE = DriftConfig(kind="none")
WORLDS = {
    "halfcheetah": EnvConfig(drift=SINE),
    "halfcheetah_at_one_physics_step": EnvConfig(drift=SINE, hz=200.0, speed=2.0),
    "halfcheetah_plain": EnvConfig(drift=NONE, hz=100.0, speed=3.0),
    "swimmer": EnvConfig(id="Swimmer-v5", drift=SINE, reward=RewardConfig(control_cost=1e-4)),
    "pointmass": EnvConfig(id="pointmass", drift=SINE),
    "pointmass_twice": EnvConfig(id="pointmass", drift=SINE, hz=10.0, speed=1.0),
    "pendulum": EnvConfig(id="Pendulum-v1", drift=NONE),
    "hopper": EnvConfig(id="Hopper-v5", drift=NONE),  # one that terminates
}
STEPS = 30


@pytest.fixture(params=list(WORLDS))
def env(request: pytest.FixtureRequest) -> EnvConfig:
    return WORLDS[request.param]


@pytest.fixture
def world(env: EnvConfig) -> Iterator[World]:
    made = make_world(env, 5)
    yield made
    made.close()


def _actions(world: World, seed: int = 1) -> list[Vector]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(world.action_low, world.action_high).astype(np.float32) for _ in range(STEPS)]


def _trace(world: World, seed: int | None) -> list[tuple[bytes, float, bytes]]:
    """Every number that a short episode shows."""
    trace = [(world.reset(seed, 0).tobytes(), 0.0, world.position().tobytes())]
    for t, action in enumerate(_actions(world)):
        outcome = world.step(action, t)
        trace.append((outcome.observation.tobytes(), outcome.reward, world.position().tobytes()))
        if outcome.terminated:
            break
    return trace


def _is_vector(array: Vector, size: int) -> None:
    assert array.shape == (size,)
    assert array.dtype == np.float32


def test_spaces(world: World) -> None:
    assert world.action_low.shape == world.action_high.shape == (world.action_dim,)
    assert world.action_low.dtype == world.action_high.dtype == np.float32
    assert np.isfinite(world.action_low).all() and (world.action_low < world.action_high).all()
    observation = world.reset(0, 0)
    _is_vector(observation, world.observation_dim)
    outcome = world.step(_actions(world)[0], 0)
    _is_vector(outcome.observation, world.observation_dim)
    assert type(outcome.reward) is float and np.isfinite(outcome.reward)
    assert world.position().dtype == np.float64
    assert (world.position().size > 0) == (world.scene != "")


def test_deterministic_by_seed(env: EnvConfig, world: World) -> None:
    first = _trace(world, 7)
    assert _trace(world, 7) == first
    assert _trace(world, 8) != first
    other = make_world(env, 99)
    assert _trace(other, 7) == first
    other.close()


def test_without_a_seed_the_world_goes_on_with_its_own(env: EnvConfig, world: World) -> None:
    twin = make_world(env, 5)
    episodes = [_trace(world, None) for _ in range(2)]
    assert [_trace(twin, None) for _ in range(2)] == episodes
    assert episodes[0] != episodes[1]
    twin.close()


def test_observations_have_memory_of_their_own(world: World) -> None:
    seen = [world.reset(3, 0)]
    actions = _actions(world)
    seen += [world.step(action, 0).observation for action in actions[:5]]
    kept = [observation.copy() for observation in seen]
    world.step(actions[5], 0)
    for number, (observation, before) in enumerate(zip(seen, kept, strict=True)):
        np.testing.assert_array_equal(observation, before)
        assert not any(np.shares_memory(observation, other) for other in seen[number + 1 :])


def test_positions_are_copies(world: World) -> None:
    world.reset(3, 0)
    before = world.position()
    kept = before.copy()
    for action in _actions(world)[:5]:
        world.step(action, 0)
    np.testing.assert_array_equal(before, kept)
    if world.scene:
        assert (world.position() != before).any()


def test_terminated_and_truncated_never_meet_and_no_time_limit_is_left(world: World) -> None:
    world.reset(3, 0)
    for _ in range(260):  # beyond Pendulum's limit of 200
        outcome = world.step(_actions(world)[0], 0)
        assert not outcome.truncated
        if outcome.terminated:
            world.reset(None, 0)


def test_drift_follows_the_unit_alone(env: EnvConfig, world: World) -> None:
    world.reset(3, 4)
    expected = [value(env.drift, t) for t in (0, 9, 9, 2)]
    assert [world.step(_actions(world)[0], t).drift for t in (0, 9, 9, 2)] == expected
    assert [world.drift(t) for t in (0, 9, 9, 2)] == expected


def test_drift_moves_the_reward_and_nothing_else() -> None:
    for name in ("halfcheetah", "pointmass"):
        world = make_world(WORLDS[name], 5)
        outcomes: list[Outcome] = []
        for t in (0, 5):
            world.reset(3, t)
            outcomes.append(world.step(_actions(world)[0], t))
        np.testing.assert_array_equal(outcomes[0].observation, outcomes[1].observation)
        assert outcomes[0].reward != outcomes[1].reward
        world.close()


def test_scene_file(world: World, tmp_path: Path) -> None:
    path = tmp_path / "world.mjb"
    world.save_scene(path)
    assert path.exists() == (world.scene == "mujoco")
    assert len(list(tmp_path.iterdir())) <= 1
    if path.exists():
        import mujoco

        assert mujoco.MjModel.from_binary_path(str(path)).nq == world.position().size


def test_a_world_that_terminates_says_so() -> None:
    world = make_world(WORLDS["hopper"], 0)
    world.reset(0, 0)
    assert any(world.step(world.action_high, 0).terminated for _ in range(200))
    world.close()


@pytest.mark.parametrize(
    ("name", "period_s"),
    [("halfcheetah", 0.05), ("halfcheetah_at_one_physics_step", 0.01), ("swimmer", 0.04)],
)
def test_speed_reward_recomputed_from_qpos(name: str, period_s: float) -> None:
    env = WORLDS[name]
    world = make_world(env, 0)
    world.reset(0, 0)
    for t, action in enumerate(_actions(world)):
        before = world.position()[0]
        outcome = world.step(action, t)
        speed = (world.position()[0] - before) / period_s
        cost = env.reward.control_cost * sum(float(a) ** 2 for a in action)
        expected = -abs(speed - (0.5 + np.sin(0.3 * t))) - cost
        assert outcome.reward == pytest.approx(expected, abs=1e-9)
    world.close()


@pytest.mark.parametrize(("env_id", "steps"), [("HalfCheetah-v5", 5), ("Swimmer-v5", 4)])
def test_speed_is_gymnasiums_own_x_velocity(env_id: str, steps: int) -> None:
    still = RewardConfig(control_cost=0.0)
    ours = make_world(EnvConfig(id=env_id, drift=DriftConfig(kind="constant", offset=100.0), reward=still), 0)
    theirs = gymnasium.make(env_id, frame_skip=steps)
    np.testing.assert_array_equal(ours.reset(4, 0), theirs.reset(seed=4)[0].astype(np.float32))
    for action in _actions(ours):
        outcome = ours.step(action, 0)
        observation, _, _, _, info = theirs.step(action)
        np.testing.assert_array_equal(outcome.observation, observation.astype(np.float32))
        assert outcome.reward == pytest.approx(info["x_velocity"] - 100.0, abs=1e-9)
    ours.close()
    theirs.close()


def test_without_drift_a_walker_keeps_gymnasiums_reward() -> None:
    ours = make_world(EnvConfig(drift=NONE), 0)
    theirs = gymnasium.make("HalfCheetah-v5")
    ours.reset(4, 0)
    theirs.reset(seed=4)
    for action in _actions(ours):
        assert ours.step(action, 0).reward == pytest.approx(float(theirs.step(action)[1]))
    ours.close()
    theirs.close()


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
    assert outcome.reward == pytest.approx(-abs((speeds[0] + speeds[1]) / 2 - value(SINE, 6)))
