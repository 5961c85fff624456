"""Requests for worlds: what is filled in, and every way to be wrong."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from env_server.worlds.gym_world import GymWorld
from env_server.worlds.names import OWN_WORLDS
from env_server.worlds.period import Timing
from env_server.worlds.registry import SPEED_WORLDS, TUNABLE, make_world, require_fit, resolve
from rtcore.config import Algo, ConfigError, DriftConfig, EnvConfig, MdpConfig, PhysicsConfig

NONE = DriftConfig(kind="none")
TWICE = DriftConfig(kind="constant", offset=2.0)


@pytest.mark.parametrize(("env_id", "timing"), SPEED_WORLDS.items())
def test_the_table_of_speed_worlds_agrees_with_the_simulator(env_id: str, timing: Timing) -> None:
    world = GymWorld(env_id, seed=0)
    assert Timing(world.native_period_s, world.physics_step_s) == timing
    assert world.tunable == TUNABLE[env_id]
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
        (EnvConfig(id="cliffworld", hz=30.0), 30.0, None),
    ],
)
def test_resolve_fills_in(env: EnvConfig, hz: float, speed: float | None) -> None:
    resolved = resolve(env)
    assert (resolved.hz, resolved.speed) == (hz, speed)
    assert resolve(resolved) == resolved


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (
            EnvConfig(id="HalfCheeta-v5"),
            r"^env.id = .*: pointmass, cliffworld, .* or a registered .* mean HalfCheetah-v5",
        ),
        (EnvConfig(id="HalfCheetah-v99"), r"^env.id = 'HalfCheetah-v99': .*did you mean"),
        (EnvConfig(id="pointmas"), r"^env.id = 'pointmas': .*did you mean pointmass"),
        (EnvConfig(id="not an id"), r"^env.id = 'not an id': cannot be built here"),
        (EnvConfig(id="no_such_module:X-v0"), r"^env.id = 'no_such_module:X-v0'"),
        (EnvConfig(id="HalfCheetah-v2"), r"^env.id = 'HalfCheetah-v2': cannot be built here"),
        (EnvConfig(id="CartPole-v1"), r"needs a continuous \(Box\) action space, not Discrete"),
        (EnvConfig(id="FrozenLake-v1"), r"needs a continuous \(Box\) observation space, not Discrete"),
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
        (EnvConfig(id="Pendulum-v1", drift=DriftConfig(kind="ou", sd=0.1)), r"^env.drift.kind = 'ou': "),
        (EnvConfig(id="Pendulum-v1", observe_actions=8000), r"^env.id = 'Pendulum-v1': an observation of 3"),
        (EnvConfig(id="cliffworld"), r"^env.hz = None: needed"),
        (EnvConfig(id="bandit", hz=9.0, speed=2.0), r"^env.speed = 2.0: bandit has no native period"),
        (EnvConfig(id="clifworld"), r"^env.id = 'clifworld': .*did you mean cliffworld"),
        (EnvConfig(id="chain", hz=9.0, notify="changed"), r"^env.notify = 'changed': \"none\" for chain"),
        (EnvConfig(id="chain", hz=9.0, observe_actions=1), r"^env.observe_actions = 1: 0 for chain"),
        (EnvConfig(id="pointmass", notify="value"), r"^env.notify = 'value': .*no value to tell"),
        (EnvConfig(id="Pendulum-v1", notify="value"), r"^env.notify = 'value': .*no value to tell"),
        (
            EnvConfig(id="random_mdp", hz=9.0, mdp=MdpConfig(states=10_000)),
            r"^env.mdp.states = 10000: with 3 actions",
        ),
        (
            EnvConfig(id="pointmass", drift=DriftConfig(kind="recorded", path="/no.csv")),
            r"^env.drift.path = '/no.csv': must be a readable file",
        ),
        (
            EnvConfig(id="pointmass", physics=PhysicsConfig(gravity=TWICE)),
            r"^env.physics.gravity.kind = 'constant': \"none\" for pointmass: only mass and friction can",
        ),
        (
            EnvConfig(id="Pendulum-v1", physics=PhysicsConfig(mass=TWICE)),
            r"^env.physics.mass.kind = 'constant': \"none\" for Pendulum-v1: its physics cannot drift",
        ),
        (
            EnvConfig(id="chain", hz=9.0, physics=PhysicsConfig(mass=TWICE)),
            r"^env.physics.mass.kind = 'constant': \"none\" for chain: its physics cannot drift",
        ),
        (
            EnvConfig(id="Swimmer-v5", drift=TWICE, physics=PhysicsConfig(friction=TWICE)),
            r"^env.physics.friction.kind = 'constant': \"none\" for Swimmer-v5: only mass can drift",
        ),
        (
            EnvConfig(id="Reacher-v5", physics=PhysicsConfig(gravity=TWICE)),
            r"^env.physics.gravity.kind = 'constant': \"none\" for Reacher-v5",
        ),
        (
            EnvConfig(physics=PhysicsConfig(mass=DriftConfig(kind="sine", offset=1.0, amplitude=1.0))),
            r"^env.physics.mass.kind = 'sine': a factor on mass must stay at 0.05 or above, .* down to 0$",
        ),
        (
            EnvConfig(physics=PhysicsConfig(mass=DriftConfig(kind="ou", sd=0.1))),  # offset 0, not 1
            r"^env.physics.mass.kind = 'ou': .* goes down to 0$",
        ),
        (
            EnvConfig(physics=PhysicsConfig(friction=DriftConfig(kind="constant", offset=-0.1))),
            r"^env.physics.friction.kind = 'constant': .* at 0 or above, but this one goes down to -0.1$",
        ),
    ],
)
def test_wrong_requests_are_one_line(env: EnvConfig, message: str) -> None:
    for ask in (resolve, lambda env: make_world(env, 0)):
        with pytest.raises(ConfigError, match=message) as caught:
            ask(env)
        assert "\n" not in str(caught.value)


def test_algorithms_fit_worlds_or_are_told_which_do() -> None:
    finite, all_algos = {"q", "fq", "npg"}, get_args(Algo)
    fits = dict.fromkeys(OWN_WORLDS, finite) | {"bandit": finite | {"tempo"}}
    fits |= {name: {"sac", "fsac", "rsac"} for name in ("pointmass", "HalfCheetah-v5", "Pendulum-v1")}
    for name, fitting in fits.items():
        for algo in all_algos:
            if algo in fitting:
                require_fit(EnvConfig(id=name), algo)
                continue
            with pytest.raises(ConfigError) as caught:
                require_fit(EnvConfig(id=name), algo)
            line = str(caught.value)
            assert line.startswith(f"learner.algo = {algo!r}: one of ") and repr(name) in line
            listed = line.split(": one of ")[1].split(" for ", maxsplit=1)[0]
            assert set(listed.split(", ")) == fitting


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
    "what",
    [
        "resolve(EnvConfig())",
        'make_world(resolve(EnvConfig(id="pointmass")), 0)',
        'make_world(resolve(EnvConfig(id="cliffworld", hz=9.0)), 0)',
    ],
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
