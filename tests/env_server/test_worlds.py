"""Requests for worlds: what is filled in, and every way to be wrong."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from env_server.worlds.gym_world import GymWorld
from env_server.worlds.period import Timing
from env_server.worlds.registry import SPEED_WORLDS, make_world, resolve
from rtcore.config import ConfigError, DriftConfig, EnvConfig

NONE = DriftConfig(kind="none")


@pytest.mark.parametrize(("env_id", "timing"), SPEED_WORLDS.items())
def test_the_table_of_speed_worlds_agrees_with_the_simulator(env_id: str, timing: Timing) -> None:
    world = GymWorld(env_id, seed=0)
    assert Timing(world.native_period_s, world.physics_step_s) == timing
    world.close()


@pytest.mark.parametrize(
    ("env", "hz", "speed"),
    [
        (EnvConfig(), 20.0, 1.0),
        (EnvConfig(id="Swimmer-v5"), 25.0, 1.0),
        (EnvConfig(id="pointmass", speed=10.0), 200.0, 10.0),
        (EnvConfig(id="Pendulum-v1"), 20.0, 1.0),
        (EnvConfig(id="HalfCheetah-v5", drift=NONE, hz=100.0, speed=2.0), 100.0, 2.0),
        (EnvConfig(id="MountainCarContinuous-v0", hz=30.0), 30.0, None),
    ],
)
def test_resolve_fills_in(env: EnvConfig, hz: float, speed: float | None) -> None:
    resolved = resolve(env)
    assert (resolved.hz, resolved.speed) == (hz, speed)
    assert resolve(resolved) == resolved


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (EnvConfig(id="HalfCheeta-v5"), r'^env.id = .*"pointmass" or a registered .* mean HalfCheetah-v5'),
        (EnvConfig(id="HalfCheetah-v99"), r"^env.id = 'HalfCheetah-v99': .*did you mean"),
        (EnvConfig(id="pointmas"), r"^env.id = 'pointmas': .*did you mean pointmass"),
        (EnvConfig(id="not an id"), r"^env.id = 'not an id': cannot be built here"),
        (EnvConfig(id="no_such_module:X-v0"), r"^env.id = 'no_such_module:X-v0'"),
        (EnvConfig(id="HalfCheetah-v2"), r"^env.id = 'HalfCheetah-v2': cannot be built here"),
        (EnvConfig(id="CartPole-v1"), r"needs a continuous \(Box\) action space for sac, not Discrete"),
        (EnvConfig(id="FrozenLake-v1"), r"needs a continuous \(Box\) observation space for sac"),
        (EnvConfig(hz=200.0, speed=3.0), r"^env.speed = 3.0: .* physics step of 0.01 s"),
        (EnvConfig(id="pointmass", hz=100.0, speed=2.0), r"^env.speed = 2.0: .* physics step of 0.05 s"),
        (EnvConfig(id="Pendulum-v1", hz=50.0, speed=1.0), r"^env.speed = 1.0: .*the fixed step of 0.05 s"),
        (
            EnvConfig(id="HalfCheetah-v4", hz=40.0, speed=4.0),
            r"^env.speed = 4.0: .* cannot change its period",
        ),
        (EnvConfig(id="MountainCarContinuous-v0"), r"^env.hz = None: needed"),
        (EnvConfig(hz=-1.0), r"^env.hz = -1.0: a finite number above 0"),
        (EnvConfig(id="Pendulum-v1", drift=DriftConfig(amplitude=1.0)), r"^env.drift.kind = 'sine': "),
        (
            EnvConfig(id="Pendulum-v1", drift=DriftConfig(kind="constant", offset=1.0)),
            r"^env.drift.kind = 'constant': ",
        ),
        (EnvConfig(id="Pendulum-v1", observe_actions=8000), r"^env.id = 'Pendulum-v1': an observation of 3"),
    ],
)
def test_wrong_requests_are_one_line(env: EnvConfig, message: str) -> None:
    for ask in (resolve, lambda env: make_world(env, 0)):
        with pytest.raises(ConfigError, match=message) as caught:
            ask(env)
        assert "\n" not in str(caught.value)


class _Odd(gymnasium.Env[Any, Any]):
    """An environment with whatever spaces a test gives it."""

    def __init__(self, **spaces: Box) -> None:
        self.observation_space = spaces["observations"]
        self.action_space = spaces["actions"]


@pytest.mark.parametrize(
    ("observations", "actions", "message"),
    [
        (
            Box(0, 255, (96, 96, 3), np.uint8),
            Box(-1, 1, (1,)),
            "an observation of 27648 numbers is too large: a step carries 7244",
        ),
        (Box(-1, 1, (2,)), Box(-np.inf, np.inf, (1,)), "needs a bounded action space"),
    ],
)
def test_spaces_that_do_not_fit(observations: Box, actions: Box, message: str) -> None:
    spaces = {"observations": observations, "actions": actions}
    gymnasium.register("TenutoOdd-v0", entry_point=_Odd, kwargs=spaces)
    try:
        with pytest.raises(ConfigError, match=message):
            resolve(EnvConfig(id="TenutoOdd-v0", hz=10.0))
    finally:
        gymnasium.registry.pop("TenutoOdd-v0")


class _Hoarder(gymnasium.Env[Any, Any]):
    """An environment that hands out its own memory, and flattens to 4 numbers and 2 actions."""

    observation_space = Box(-9, 9, (2, 2))
    action_space = Box(-1, 1, (2, 1), np.float64)

    def __init__(self, **_options: Any) -> None:
        self.state = np.zeros((2, 2), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        self.state = np.zeros((2, 2), np.float32)
        return self.state, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action.shape == (2, 1) and action.dtype == np.float64
        self.state += action
        return self.state, 1, True, True, {}


def test_shapes_are_flattened_and_memory_is_copied() -> None:
    gymnasium.register("TenutoHoarder-v0", entry_point=_Hoarder)
    try:
        world = make_world(EnvConfig(id="TenutoHoarder-v0", hz=10.0), 0)
    finally:
        gymnasium.registry.pop("TenutoHoarder-v0")
    first = world.reset(0, 0)
    outcome = world.step(np.array([1.0, -0.5], np.float32), 0)
    assert first.tolist() == [0, 0, 0, 0]
    assert outcome.observation.tolist() == [1, 1, -0.5, -0.5]
    assert (outcome.reward, outcome.terminated, outcome.truncated) == (1.0, True, False)
    assert world.action_low.tolist() == [-1, -1]


@pytest.mark.parametrize(
    "what", ["resolve(EnvConfig())", 'make_world(resolve(EnvConfig(id="pointmass")), 0)']
)
def test_no_simulator_is_loaded_where_none_is_needed(what: str) -> None:
    code = (
        "import sys; from env_server.worlds.registry import make_world, resolve; "
        "from rtcore.config import EnvConfig; "
        f"{what}; print([name for name in ('gymnasium', 'mujoco') if name in sys.modules])"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
