"""How fast the simulated world runs: wall-clock rate, speed and physics steps per tick. Pure.

One tick of 1/hz wall seconds simulates speed/hz seconds, which must be whole physics steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from rtcore.config import ConfigError, EnvConfig

_TOLERANCE = 1e-6  # relative; far above float rounding, far below half a physics step of any period in use


@dataclass(frozen=True, slots=True)
class Timing:
    """The time scale of a world.

    Attributes:
        native_s: simulated seconds per step as its authors meant it; None: it has no time scale.
        physics_s: simulated seconds per physics step; None: the period of a step cannot be chosen.
    """

    native_s: float | None
    physics_s: float | None


def resolve_period(env: EnvConfig, timing: Timing) -> EnvConfig:
    """Fill in `hz` and `speed`: whichever is missing follows from the native period.

    With neither given the world runs at speed 1; with both, the number of physics steps per tick
    follows. A world without a time scale needs `hz` and has no speed.

    Raises:
        ConfigError: a value is not positive, or the world cannot run at that period.
    """
    for name, given in (("env.hz", env.hz), ("env.speed", env.speed)):
        if given is not None and not (math.isfinite(given) and given > 0):
            raise ConfigError(name, given, "a finite number above 0")
    if timing.native_s is None:
        return _without_scale(env)
    if env.hz is None:
        speed = 1.0 if env.speed is None else env.speed
        env = replace(env, speed=speed, hz=speed / timing.native_s)
    elif env.speed is None:
        env = replace(env, speed=env.hz * timing.native_s)
    physics_steps(env, timing)
    return env


def physics_steps(env: EnvConfig, timing: Timing) -> int:
    """Physics steps per tick of a resolved `env`; 1 where the period of a step cannot be chosen.

    Raises:
        ConfigError: the simulated period is no whole multiple of the physics step.
    """
    if timing.native_s is None or env.hz is None or env.speed is None:
        return 1
    period_s = env.speed / env.hz
    step_s = timing.physics_s or timing.native_s
    count = round(period_s / step_s)
    whole = count >= 1 and abs(period_s - count * step_s) <= _TOLERANCE * step_s
    if whole and (timing.physics_s is not None or count == 1):
        return count
    raise ConfigError("env.speed", env.speed, _allowed(env, timing, period_s))


def tick_ns(env: EnvConfig) -> int:
    """The control period 1/hz in nanoseconds, rounded, of a resolved `env`."""
    if env.hz is None:
        raise ConfigError("env.hz", None, "resolve the environment first")
    return max(1, round(1e9 / env.hz))


def num_ticks(env: EnvConfig, duration_s: float) -> int:
    """Deadlines in a run of `duration_s`, one at least; 0: it goes on until stopped.

    By the whole nanoseconds of a period: duration times rate is one more in two hours at 600 Hz.
    """
    return max(1, round(duration_s * 1e9 / tick_ns(env))) if duration_s > 0 else 0


def _without_scale(env: EnvConfig) -> EnvConfig:
    if env.speed is not None:
        raise ConfigError("env.speed", env.speed, f"{env.id} has no native period; give env.hz alone")
    if env.hz is None:
        raise ConfigError("env.hz", env.hz, f"needed, since {env.id} has no native period")
    return env


def _allowed(env: EnvConfig, timing: Timing, period_s: float) -> str:
    if timing.physics_s is None:
        return (
            f"at env.hz = {env.hz:g} the period of {period_s:g} s is not the fixed step of "
            f"{timing.native_s:g} s of {env.id}; leave one of env.hz and env.speed out"
        )
    return (
        f"at env.hz = {env.hz:g} the period of {period_s:g} s is no whole multiple of the physics step "
        f"of {timing.physics_s:g} s; leave env.hz or env.speed out for the native period"
    )
