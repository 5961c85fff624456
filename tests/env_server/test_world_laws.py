"""What every world keeps to, and what the reward of the simulated ones is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from env_server.wording import word_spec
from env_server.worlds.drift import make_drift
from env_server.worlds.registry import make_world
from env_server.worlds.world import Outcome, Vector, World
from rtcore.config import DriftConfig, EnvConfig, Notify, PhysicsConfig, RewardConfig
from rtcore.epoch import Epoch
from rtcore.messages import Step
from tests.env_server.every_world import NONE, SINE, WORLDS
from tests.env_server.rig import Rig, run_config
from tests.env_server.scripted import ScriptedAgent

STEPS = 30
# Something of them is drawn from the run's seed, once: the others are the same in every run.
DRAWN = [WORLDS[name] for name in ("halfcheetah_walk", "halfcheetah_physics", "hopper_physics", "random_mdp")]


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
    if world.actions:
        return [rng.integers(world.actions, size=1).astype(np.float32) for _ in range(STEPS)]
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


def test_numbered_spaces(world: World) -> None:
    assert (world.states > 0) == (world.actions > 0)
    if not world.states:
        return
    assert world.observation_dim == world.action_dim == 1
    assert (world.action_low.tolist(), world.action_high.tolist()) == ([0.0], [world.actions - 1.0])
    seen = [world.reset(0, 0)] + [world.step(action, 0).observation for action in _actions(world)]
    assert {float(observation[0]) for observation in seen} <= set(map(float, range(world.states)))


def test_deterministic_by_seed(env: EnvConfig, world: World) -> None:
    first = _trace(world, 7)
    assert _trace(world, 7) == first
    if env.id != "cliffworld":  # nothing in it is random
        assert _trace(world, 8) != first
    for seed in (5, 99):  # the run's
        other = make_world(env, seed)
        assert (_trace(other, 7) == first) == (seed == 5 or env not in DRAWN)
        other.close()


def test_without_a_seed_the_world_goes_on_with_its_own(env: EnvConfig, world: World) -> None:
    twin = make_world(env, 5)
    episodes = [_trace(world, None) for _ in range(2)]
    assert [_trace(twin, None) for _ in range(2)] == episodes
    if env.id != "cliffworld":
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
    if world.scene and world.scene != "grid":  # there a move against the edge leads nowhere
        assert (world.position() != before).any()


def test_terminated_and_truncated_never_meet_and_no_time_limit_is_left(world: World) -> None:
    world.reset(3, 0)
    for _ in range(260):  # beyond Pendulum's limit of 200
        outcome = world.step(_actions(world)[0], 0)
        assert not outcome.truncated
        if outcome.terminated:
            world.reset(None, 0)


def test_drift_is_a_function_of_the_unit_alone(env: EnvConfig, world: World) -> None:
    """Whatever was done, in whichever order it is asked for, before and after resets, in another world."""
    drift = make_drift(env.drift, 5)
    other = make_world(env, 5)
    expected = {t: drift.value(t) for t in (300, 0, 9, 2)}
    physics = {t: other.physics(t) for t in (2, 300, 0, 9)}
    other.close()
    for number, t in enumerate((9, 0, 300, 2, 9, 0)):
        if number % 3 == 0:
            world.reset(None, t)
        assert (world.drift(t), world.physics(t)) == (expected[t], physics[t])
        assert world.step(_actions(world)[number], t).drift == expected[t]
        assert (world.drift(t), world.physics(t)) == (expected[t], physics[t])
    assert len(set(expected.values())) > 1 or env.drift.kind == "none"
    assert len(set(physics.values())) > 1 or env.physics == PhysicsConfig()
    if env.physics == PhysicsConfig():
        assert set(physics.values()) == {()}


UNIT_TICKS = 5


def _units_of(env: EnvConfig, world: World, *, stall: int | None = None) -> tuple[list[Step], int]:
    """The steps of 60 ticks, 5 to a unit, with no agent answering; at tick `stall` the env server sleeps for
    12 ticks and a half. Also the number of skipped ticks."""
    hz = env.hz or 20.0
    run = run_config(duration_s=60 / hz, seed=5, id=env.id, hz=hz, speed=env.speed, unit_s=UNIT_TICKS / hz)
    run = replace(run, env=replace(env, hz=hz, speed=run.env.speed, unit_s=run.env.unit_s, episode_steps=7))
    rig = Rig(run, world)

    def nobody(_agent: ScriptedAgent, step: Step) -> None:
        if step.tick == stall:
            rig.clock.sleep_until_ns(rig.clock.now_ns() + round(12.5e9 / hz))

    steps = rig.run(nobody)
    assert rig.ledger.counter("missed") == sum(step.episode_tick > 0 for step in steps)
    return steps, rig.service.pacer.skipped_total


@pytest.mark.parametrize("stall", [None, 13])
def test_drift_goes_on_by_the_clock_while_nobody_acts(
    env: EnvConfig, world: World, stall: int | None
) -> None:
    steps, skipped = _units_of(env, world, stall=stall)
    drift, twin = make_drift(env.drift, 5), make_world(env, 5)
    assert skipped == (0 if stall is None else 11)  # the 12th deadline was the latest one that had passed
    assert len(steps) == 60 - skipped
    assert [step.unit for step in steps] == [step.tick // UNIT_TICKS for step in steps]
    assert [step.drift for step in steps] == [drift.value(step.unit) for step in steps]
    assert [tuple(step.physics) for step in steps] == [twin.physics(step.unit) for step in steps]
    twin.close()


@pytest.mark.parametrize(("notify", "dim"), [("none", 3), ("changed", 4), ("value", 4)])
def test_the_spec_declares_what_the_steps_carry(notify: Notify, dim: int) -> None:
    run = run_config(duration_s=0.5, notify=notify, observe_actions=2)
    run = replace(run, env=replace(run.env, drift=SINE))
    world = make_world(run.env, 0)
    steps = Rig(run, world).run()
    epoch = Epoch(t0_ns=0, wall_t0_ns=0, boot_id="")
    spec = word_spec(run.env, world, epoch, incarnation=1, tick_ns=1)
    assert {len(step.observation) // 4 for step in steps} == {spec.observation_dim} == {dim}
    told = [float(np.frombuffer(step.observation, "<f4")[1]) for step in steps]  # after the speed
    if notify == "value":
        assert told == [float(np.float32(step.drift)) for step in steps]
    if notify == "changed":
        assert told == [float(step.unit > 0) for step in steps]


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
    assert path.exists() == (world.scene == "mujoco")  # a board stands beside it, in a file of its own
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
