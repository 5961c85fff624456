"""Physics that drift: factors on the mass, friction and gravity that a world was built with, by the unit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from env_server.worlds.drift import FRICTION, GRAVITY, MASS, make_drift
from rtcore.config import ConfigError, DriftConfig, PhysicsConfig

# A random drift may wander anywhere, and at 0 nothing could be simulated. HalfCheetah under random full
# actions stayed finite for 20 000 steps even at 0.01, with speeds of the joints up to 150 rad/s (0.05: 100).
LEAST_MASS = 0.05


class Factors(NamedTuple):
    """What multiplies the world's own physics; 1 leaves it alone. The order of `Step.physics`."""

    mass: float
    friction: float
    gravity: float


class Physics:
    """The factors over the units.

    Attributes:
        drifts: whether any of them may differ from 1.
    """

    def __init__(self, config: PhysicsConfig, seed: int) -> None:
        """Reads the files of recorded drifts; `seed` is the run's.

        Raises:
            ConfigError: a factor is known to get too low, or a file cannot be used.
        """
        named = {name: getattr(config, name) for name in Factors._fields}
        streams = Factors(MASS, FRICTION, GRAVITY)._asdict()
        self._drifts = {
            name: make_drift(drift, seed, stream=streams[name], field=f"env.physics.{name}", neutral=1.0)
            for name, drift in named.items()
        }
        for name, drift in self._drifts.items():
            _check_positive(name, named[name], drift.lowest)
        self.drifts = any(drift.kind != "none" for drift in named.values())

    def factors(self, t: int) -> Factors:
        """The factors in unit t >= 0. A random drift that falls too low counts as `LEAST_MASS`, or as 0."""
        values = {name: drift.value(t) for name, drift in self._drifts.items()}
        return Factors(
            max(values["mass"], LEAST_MASS), max(values["friction"], 0.0), max(values["gravity"], 0.0)
        )

    def told(self, t: int) -> tuple[float, ...]:
        """The factors as a step reports them: none if nothing drifts."""
        return tuple(self.factors(t)) if self.drifts else ()


def check_physics(config: PhysicsConfig, env_id: str, tunable: Sequence[str]) -> None:
    """Only what a world has can drift.

    Args:
        config: asks for drifts.
        env_id: of the world.
        tunable: which of the factors mean something in it.

    Raises:
        ConfigError: another one is asked for.
    """
    for name in Factors._fields:
        drift: DriftConfig = getattr(config, name)
        if drift.kind != "none" and name not in tunable:
            has = f"only {' and '.join(tunable)} can drift" if tunable else "its physics cannot drift"
            raise ConfigError(f"env.physics.{name}.kind", drift.kind, f'"none" for {env_id}: {has}')


def _check_positive(name: str, config: DriftConfig, lowest: float) -> None:
    """Where the lowest value is known it must do; where it is not (-inf), `factors` stops what wanders off,
    but it must start well."""
    if lowest == float("-inf"):
        lowest = config.offset
    least = LEAST_MASS if name == "mass" else 0.0
    if lowest < least:
        allowed = f"a factor on {name} must stay at {least:g} or above, but this one goes down to {lowest:g}"
        raise ConfigError(f"env.physics.{name}.kind", config.kind, allowed)
