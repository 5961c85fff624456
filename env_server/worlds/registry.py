"""Which worlds there are, and what is wrong with a request for one.

Importing this module loads no simulator; each world's own module is imported when it is asked for.
"""

from __future__ import annotations

from env_server.worlds.period import Timing, physics_steps, resolve_period
from env_server.worlds.world import World
from rtcore import channels
from rtcore.config import ConfigError, EnvConfig

POINTMASS = "pointmass"

# The walkers that get a drifting target speed, with Gymnasium's own time scale. A test compares these
# with the simulator; they are repeated here so that a command line can be checked without loading it.
SPEED_WORLDS = {
    "HalfCheetah-v5": Timing(native_s=0.05, physics_s=0.01),
    "Swimmer-v5": Timing(native_s=0.04, physics_s=0.01),
}

_STEP_OVERHEAD = 1024  # bytes of a step besides observation, actions and position


def resolve(env: EnvConfig) -> EnvConfig:
    """Check that this world can be had, and fill in `hz` and `speed`.

    Idempotent, and creates nothing that lasts.

    Raises:
        ConfigError: unknown id, unsuitable spaces, impossible period, or drift in a world without.
    """
    timing = _timing(env)
    resolved = resolve_period(env, timing)
    if _is_plain_gym(env) and (frame_skip := _frame_skip(resolved, timing)):
        _inspect(resolved, frame_skip)
    return resolved


def make_world(env: EnvConfig, seed: int) -> World:
    """Build the world that `env` describes.

    Raises:
        ConfigError: as `resolve`.
    """
    timing = _timing(env)
    env = resolve_period(env, timing)
    if _is_plain_gym(env):
        return _gym_world(env, seed, _frame_skip(env, timing))
    steps = physics_steps(env, timing)
    if env.id == POINTMASS:
        from env_server.worlds.pointmass import PointMass

        return PointMass(env.drift, env.reward, seed=seed, steps=steps)
    from env_server.worlds.mujoco_speed import SpeedWorld

    return SpeedWorld(env.id, env.drift, env.reward, timing=timing, steps=steps, seed=seed)


def _is_plain_gym(env: EnvConfig) -> bool:
    return env.id != POINTMASS and not _chases_speed(env)


def _frame_skip(env: EnvConfig, timing: Timing) -> int | None:
    """Physics steps per tick of a resolved `env`; None where they are the registered ones."""
    if timing.native_s is None or timing.physics_s is None:
        return None
    steps = physics_steps(env, timing)
    return None if steps == round(timing.native_s / timing.physics_s) else steps


def _chases_speed(env: EnvConfig) -> bool:
    """Without a drift, HalfCheetah and Swimmer are plain Gymnasium environments with their own reward."""
    return env.id in SPEED_WORLDS and env.drift.kind != "none"


def _timing(env: EnvConfig) -> Timing:
    if env.id == POINTMASS:
        from env_server.worlds.pointmass import TIMING

        return TIMING
    if _chases_speed(env):
        return SPEED_WORLDS[env.id]
    drift = env.drift
    moves = drift.kind == "sine" and (drift.offset or drift.amplitude)
    if moves or (drift.kind == "constant" and drift.offset):
        allowed = f'"none": only {", ".join([*SPEED_WORLDS, POINTMASS])} have a target that drifts'
        raise ConfigError("env.drift.kind", drift.kind, allowed)
    return _inspect(env, None)


def _inspect(env: EnvConfig, frame_skip: int | None) -> Timing:
    """Build and free the Gymnasium environment to learn its time scale and whether a step can carry it."""
    world = _gym_world(env, 0, frame_skip)
    try:
        _check_size(env, world)
        return Timing(world.native_period_s, world.physics_step_s)
    finally:
        world.close()


def _gym_world(env: EnvConfig, seed: int, frame_skip: int | None) -> World:
    from env_server.worlds.gym_world import GymWorld

    try:
        return GymWorld(env.id, seed=seed, frame_skip=frame_skip)
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
