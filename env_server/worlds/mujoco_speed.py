"""HalfCheetah and Swimmer with a target speed that drifts (paper, appendix, environments)."""

from __future__ import annotations

from pathlib import Path

from env_server.worlds.drift import make_drift
from env_server.worlds.gym_world import GymWorld
from env_server.worlds.period import Timing
from env_server.worlds.physics import Physics
from env_server.worlds.reward import speed_reward
from env_server.worlds.world import Outcome, Position, Vector
from rtcore.config import DriftConfig, RewardConfig


class SpeedWorld:
    """A MuJoCo walker rewarded for a forward speed of v_d(t); the agent does not see the target.

    Dynamics, observation and reset are Gymnasium's; only the reward is ours. The coordinate that
    moves forward is the first of qpos, in metres.
    """

    states = actions = 0
    physics_step_s: float | None
    native_period_s: float | None
    scene = "mujoco"

    def __init__(
        self,
        env_id: str,
        drift: DriftConfig,
        reward: RewardConfig,
        *,
        timing: Timing,
        steps: int,
        seed: int,
        physics: Physics | None = None,
    ) -> None:
        """`steps` physics steps pass per tick; `timing` is the world's own, from the registry."""
        self._world = GymWorld(env_id, seed=seed, frame_skip=steps, physics=physics)
        self._drift = make_drift(drift, seed)
        self._reward = reward
        self.native_period_s, self.physics_step_s = timing.native_s, timing.physics_s
        assert timing.physics_s is not None
        assert self._world.physics_step_s == timing.physics_s, "the table of worlds is out of date"
        self._period_s = steps * timing.physics_s
        self.observation_dim = self._world.observation_dim
        self.action_dim = self._world.action_dim
        self.action_low, self.action_high = self._world.action_low, self._world.action_high

    def reset(self, seed: int | None, t: int, /) -> Vector:
        """Begin an episode."""
        return self._world.reset(seed, t)

    def step(self, action: Vector, t: int, /) -> Outcome:
        """One tick; v is the distance covered over it by the simulated time it took."""
        before_m = self._forward_m()
        plain = self._world.step(action, t)
        speed = (self._forward_m() - before_m) / self._period_s
        target = self._drift.value(t)
        reward = speed_reward(self._reward, speed=speed, target=target, action=action)
        return Outcome(plain.observation, reward, plain.terminated, plain.truncated, drift=target)

    def drift(self, t: int, /) -> float:
        """The target speed v_d(t) in m/s."""
        return self._drift.value(t)

    def physics(self, t: int, /) -> tuple[float, ...]:
        """The factors of unit t."""
        return self._world.physics(t)

    def position(self) -> Position:
        """The walker's qpos."""
        return self._world.position()

    def save_scene(self, path: Path, /) -> None:
        """Write the compiled model as MJB."""
        self._world.save_scene(path)

    def close(self) -> None:
        """Free the simulator."""
        self._world.close()

    def _forward_m(self) -> float:
        return float(self._world.position()[0])
