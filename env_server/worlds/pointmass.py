"""A point on a line that chases a drifting speed: the cheapest world worth learning in.

    v' = (1 - 0.2 c) v + (0.5 / m) a + 0.05 n,    n ~ N(0, 1),    per native period of 0.05 s

with the factors m on its mass and c on its friction, both 1 unless they drift; the point stops in a period
when 0.2 c is 1 or more. It has no gravity.

The agent sees v alone, never the target. Standing still earns minus the mean of |v_d|.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from env_server.worlds.drift import make_drift
from env_server.worlds.period import Timing
from env_server.worlds.physics import Physics
from env_server.worlds.reward import speed_reward
from env_server.worlds.world import Outcome, Position, Vector
from rtcore.config import DriftConfig, PhysicsConfig, RewardConfig

_PERIOD_S = 0.05
TIMING = Timing(native_s=_PERIOD_S, physics_s=_PERIOD_S)

TUNABLE = ("mass", "friction")

_FRICTION = 0.2  # share of the speed that is lost in a period
_GAIN = 0.5  # so a full action holds a speed of 2.5
_NOISE = 0.05
_START_SPEED = 0.1  # the first speed is uniform within plus or minus this, m/s


class PointMass:
    """The `pointmass` world: observation [v] in m/s, action [a] in [-1, 1]."""

    states = actions = 0
    observation_dim = 1
    action_dim = 1
    native_period_s: float | None = TIMING.native_s
    physics_step_s: float | None = TIMING.physics_s
    scene = "point"

    def __init__(
        self,
        drift: DriftConfig,
        reward: RewardConfig,
        *,
        seed: int,
        steps: int = 1,
        physics: Physics | None = None,
    ) -> None:
        """`steps` native periods pass per tick, under one action; noise comes from `seed`, and `physics`
        says what drifts of the dynamics; None: nothing.
        """
        self.action_low: Vector = np.array([-1.0], np.float32)
        self.action_high: Vector = np.array([1.0], np.float32)
        self._drift = make_drift(drift, seed)
        self._physics = physics or Physics(PhysicsConfig(), seed)
        self._reward = reward
        self._steps = steps
        self._random = np.random.default_rng(seed)
        self._position_m = 0.0
        self._speed = 0.0

    def reset(self, seed: int | None, _t: int, /) -> Vector:
        """Back to the origin, nearly at rest."""
        if seed is not None:
            self._random = np.random.default_rng(seed)
        self._position_m = 0.0
        self._speed = float(self._random.uniform(-_START_SPEED, _START_SPEED))
        return self._observe()

    def step(self, action: Vector, t: int, /) -> Outcome:
        """Move for `steps` periods; the speed rewarded is the mean forward speed over them."""
        factors = self._physics.factors(t)
        decay, gain = max(1.0 - _FRICTION * factors.friction, 0.0), _GAIN / factors.mass
        travelled = 0.0
        for _ in range(self._steps):
            noise = _NOISE * float(self._random.standard_normal())
            self._speed = decay * self._speed + gain * float(action[0]) + noise
            travelled += self._speed
        self._position_m += travelled * _PERIOD_S
        target = self._drift.value(t)
        reward = speed_reward(self._reward, speed=travelled / self._steps, target=target, action=action)
        return Outcome(self._observe(), reward, terminated=False, truncated=False, drift=target)

    def drift(self, t: int, /) -> float:
        """The target speed v_d(t) in m/s."""
        return self._drift.value(t)

    def physics(self, t: int, /) -> tuple[float, ...]:
        """The factors of unit t."""
        return self._physics.told(t)

    def position(self) -> Position:
        """float64 [1]: metres from the origin."""
        return np.array([self._position_m])

    def save_scene(self, _path: Path, /) -> None:
        """A point needs no file."""

    def close(self) -> None:
        """Nothing to free."""

    def _observe(self) -> Vector:
        return np.array([self._speed], np.float32)
