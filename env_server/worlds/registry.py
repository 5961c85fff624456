"""Which worlds there are, and what is wrong with a request for one.

Importing this module loads no simulator; each world's own module is imported when it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from env_server.worlds.drift import make_drift
from env_server.worlds.names import BANDIT, CHAIN, CLIFFWORLD, FINITE_WORLDS, OWN_WORLDS, POINTMASS
from env_server.worlds.period import Timing, physics_steps, resolve_period
from env_server.worlds.physics import Factors, Physics, check_physics
from env_server.worlds.world import World
from rtcore import channels
from rtcore.config import DEEP, TABULAR, Algo, ConfigError, DriftConfig, EnvConfig, RewardModelConfig

# The walkers that get a drifting target speed, with Gymnasium's own time scale, and what of their physics
# can drift. A test compares these with the simulator; they are repeated here so that a command line can be
# checked without loading it. Swimmer touches nothing and swims in a plane that gravity does not pull along.
SPEED_WORLDS = {
    "HalfCheetah-v5": Timing(native_s=0.05, physics_s=0.01),
    "Swimmer-v5": Timing(native_s=0.04, physics_s=0.01),
}
TUNABLE = {"HalfCheetah-v5": ("mass", "friction", "gravity"), "Swimmer-v5": ("mass",)}


_STEP_OVERHEAD = 1024  # bytes of a step besides observation, actions and position


def resolve(env: EnvConfig) -> EnvConfig:
    """Check that this world can be had, fill in `hz` and `speed`, and make the paths absolute.

    Idempotent, and creates nothing that lasts.

    Raises:
        ConfigError: unknown id, unsuitable spaces, impossible period, a drift that cannot be, or in a world
            without.
    """
    env = _with_absolute_paths(env)
    timing = _timing(env)
    resolved = resolve_period(env, timing)
    if _is_plain_gym(env) and (frame_skip := _frame_skip(resolved, timing)):
        _inspect(resolved, frame_skip)
    return resolved


def require_fit(env: EnvConfig, algo: Algo) -> None:
    """Tables need numbered states and actions, networks continuous ones.

    Raises:
        ConfigError: the algorithm cannot learn in this world.
    """
    fitting, others = DEEP, f"; tables are for {', '.join(FINITE_WORLDS)}"
    if env.id in FINITE_WORLDS:
        everywhere = tuple(name for name in TABULAR if name != "tempo")
        fitting, others = TABULAR if env.id == BANDIT else everywhere, ", whose states are numbered"
    if algo not in fitting:
        raise ConfigError("learner.algo", algo, f"one of {', '.join(fitting)} for {env.id!r}{others}")


def require_speed(env: EnvConfig, reward: RewardModelConfig) -> None:
    """The declared family of rewards belongs to worlds with a target speed, and reads the speed from an
    observation of a resolved `env`.

    Raises:
        ConfigError: this world has no target speed, or its observation no such entry.
    """
    if reward.model == "learned":
        return
    if _is_plain_gym(env):
        allowed = (
            f"must be 'learned' for {env.id!r} without a drift: its reward is not that of a target speed"
        )
        raise ConfigError("learner.reward.model", reward.model, allowed)
    with closing(make_world(env, 0)) as world:
        if reward.speed_entry >= world.observation_dim:
            allowed = f"must be below {world.observation_dim}, the numbers in an observation of {env.id!r}"
            raise ConfigError("learner.reward.speed_entry", reward.speed_entry, allowed)


def make_world(env: EnvConfig, seed: int) -> World:
    """Build the world that `env` describes; `seed` is the run's.

    Raises:
        ConfigError: as `resolve`.
    """
    timing = _timing(env)
    env = resolve_period(env, timing)
    if env.id in FINITE_WORLDS:
        return _finite_world(env, seed)
    physics = Physics(env.physics, seed)
    if _is_plain_gym(env):
        return _gym_world(env, seed, _frame_skip(env, timing), physics)
    steps = physics_steps(env, timing)
    if env.id == POINTMASS:
        from env_server.worlds.pointmass import PointMass

        return PointMass(env.drift, env.reward, seed=seed, steps=steps, physics=physics)
    from env_server.worlds.mujoco_speed import SpeedWorld

    return SpeedWorld(env.id, env.drift, env.reward, timing=timing, steps=steps, seed=seed, physics=physics)


def _finite_world(env: EnvConfig, seed: int) -> World:
    drift: Callable[[int], float] = make_drift(env.drift, seed).value
    if env.id == BANDIT:
        from env_server.worlds.bandit import Bandit

        return Bandit(drift, seed=seed)
    if env.id == CLIFFWORLD:
        from env_server.worlds.cliffworld import Cliffworld

        return Cliffworld(env.cliff, drift, seed=seed)
    from env_server.worlds.mdp import Chain, RandomMdp

    return (Chain if env.id == CHAIN else RandomMdp)(drift, env.mdp, seed=seed)


def _is_plain_gym(env: EnvConfig) -> bool:
    return env.id not in OWN_WORLDS and not _chases_speed(env)


def _frame_skip(env: EnvConfig, timing: Timing) -> int | None:
    """Physics steps per tick of a resolved `env`; None where they are the registered ones."""
    if timing.native_s is None or timing.physics_s is None:
        return None
    steps = physics_steps(env, timing)
    return None if steps == round(timing.native_s / timing.physics_s) else steps


def _chases_speed(env: EnvConfig) -> bool:
    """Without a drift, HalfCheetah and Swimmer are plain Gymnasium environments with their own reward."""
    return env.id in SPEED_WORLDS and env.drift.kind != "none"


def _with_absolute_paths(env: EnvConfig) -> EnvConfig:
    """So that the run's saved configuration repeats it from any directory."""

    def absolute(drift: DriftConfig) -> DriftConfig:
        if drift.kind != "recorded" or not drift.path:
            return drift
        return replace(drift, path=str(Path(drift.path).expanduser().absolute()))

    factors = {name: absolute(getattr(env.physics, name)) for name in Factors._fields}
    return replace(env, drift=absolute(env.drift), physics=replace(env.physics, **factors))


def _timing(env: EnvConfig) -> Timing:
    """The world's time scale, once nothing is wrong with what is asked of the world."""
    make_drift(env.drift, 0)  # raises where they cannot be
    Physics(env.physics, 0)
    _check_notify(env)
    if env.id in FINITE_WORLDS:
        check_physics(env.physics, env.id, ())
        _finite_world(env, 0)  # raises where its tables cannot be
        return Timing(native_s=None, physics_s=None)
    if env.id == POINTMASS:
        from env_server.worlds.pointmass import TIMING
        from env_server.worlds.pointmass import TUNABLE as OF_A_POINT

        check_physics(env.physics, env.id, OF_A_POINT)
        return TIMING
    if _chases_speed(env):
        check_physics(env.physics, env.id, TUNABLE[env.id])
        return SPEED_WORLDS[env.id]
    if not env.drift.still:
        allowed = f'"none": only {", ".join([*SPEED_WORLDS, *OWN_WORLDS])} have a target that drifts'
        raise ConfigError("env.drift.kind", env.drift.kind, allowed)
    return _inspect(env, None)


def _check_notify(env: EnvConfig) -> None:
    if env.id in FINITE_WORLDS:
        if env.notify != "none":
            raise ConfigError("env.notify", env.notify, f'"none" for {env.id}: a table has no place for it')
        if env.observe_actions:
            allowed = f"0 for {env.id}: a table has no place for them"
            raise ConfigError("env.observe_actions", env.observe_actions, allowed)
    elif env.notify == "value" and env.drift.still:
        raise ConfigError("env.notify", env.notify, '"none" or "changed": env.drift has no value to tell')


def _inspect(env: EnvConfig, frame_skip: int | None) -> Timing:
    """Build and free the Gymnasium environment to learn its time scale, what of its physics can drift, and
    whether a step can carry it."""
    from env_server.worlds.gym_world import GymWorld

    world = _gym_world(env, 0, frame_skip, None)
    assert isinstance(world, GymWorld)
    try:
        _check_size(env, world)
        check_physics(env.physics, env.id, world.tunable)
        return Timing(world.native_period_s, world.physics_step_s)
    finally:
        world.close()


def _gym_world(env: EnvConfig, seed: int, frame_skip: int | None, physics: Physics | None) -> World:
    from env_server.worlds.gym_world import GymWorld

    try:
        return GymWorld(env.id, seed=seed, frame_skip=frame_skip, physics=physics)
    except TypeError as error:
        if frame_skip is None:
            raise
        allowed = f"{env.id} cannot change its period; leave env.hz or env.speed out"
        raise ConfigError("env.speed", env.speed, allowed) from error


def _check_size(env: EnvConfig, world: World) -> None:
    numbers = world.observation_dim + (env.observe_actions + 2) * world.action_dim
    limit = (channels.STEP.max_bytes - _STEP_OVERHEAD) // 4
    if numbers > limit:
        allowed = f"an observation of {world.observation_dim} numbers is too large: a step carries {limit}"
        raise ConfigError("env.id", env.id, allowed)
