"""Any Gymnasium environment with continuous observations and actions, as a world.

Imports gymnasium, and MuJoCo where the environment is a MuJoCo one: `env_server.worlds.registry` loads this
module only for the worlds that need it.
"""

from __future__ import annotations

import difflib
import logging
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from env_server.worlds.names import OWN_WORLDS
from env_server.worlds.physics import Physics
from env_server.worlds.world import Outcome, Position, Vector
from rtcore.config import ConfigError

if TYPE_CHECKING:
    from env_server.worlds.mujoco_physics import ModelPhysics

_LOG = logging.getLogger(__name__)


class GymWorld:
    """An environment under its own reward, without its time limit; only its physics may drift.

    Observations and actions are flattened to float32 vectors.
    """

    states = actions = 0

    def __init__(
        self, env_id: str, *, seed: int, frame_skip: int | None = None, physics: Physics | None = None
    ) -> None:
        """Builds the environment.

        Args:
            env_id: a registered Gymnasium id.
            seed: of the first episode that is reset without a seed.
            frame_skip: physics steps per step, MuJoCo environments only; None: as registered.
            physics: what drifts of a MuJoCo environment; None: nothing.

        Raises:
            ConfigError: no such environment, or its spaces are not continuous.
            TypeError: the environment's constructor takes no `frame_skip`.
        """
        self._env = _make(env_id, frame_skip)
        try:
            self._observations = _box(env_id, self._env.observation_space, "observation")
            self._actions = _box(env_id, self._env.action_space, "action")
            self.action_low, self.action_high = _bounds(env_id, self._actions)
        except ConfigError:
            self._env.close()
            raise
        inner: Any = self._env.unwrapped
        self._model = getattr(inner, "model", None) if hasattr(inner, "frame_skip") else None
        self._inner = inner
        self._seed: int | None = seed
        self._physics = physics
        self._tuned = None if physics is None or not physics.drifts else self._tune(physics)

    @property
    def observation_dim(self) -> int:
        """Numbers in a flattened observation."""
        return int(np.prod(self._observations.shape))

    @property
    def action_dim(self) -> int:
        """Numbers in a flattened action."""
        return int(np.prod(self._actions.shape))

    @property
    def native_period_s(self) -> float | None:
        """The environment's own `dt`, where it has one."""
        period_s = getattr(self._inner, "dt", None)
        return float(period_s) if isinstance(period_s, int | float) and period_s > 0 else None

    @property
    def physics_step_s(self) -> float | None:
        """MuJoCo's time step; None for the others, whose period is fixed."""
        return None if self._model is None else float(self._model.opt.timestep)

    @property
    def scene(self) -> str:
        """`mujoco` or nothing."""
        return "" if self._model is None else "mujoco"

    @property
    def tunable(self) -> tuple[str, ...]:
        """Which of mass, friction and gravity can drift."""
        if self._model is None:
            return ()
        from env_server.worlds.mujoco_physics import tunable

        return tunable(self._model)

    def reset(self, seed: int | None, t: int, /) -> Vector:
        """Begin an episode."""
        if self._tuned is not None:
            self._tuned.apply(t)
        seed, self._seed = (self._seed if seed is None else seed), None
        observation, _ = self._env.reset(seed=seed)
        return _flat(observation)

    def step(self, action: Vector, t: int, /) -> Outcome:
        """One step of the environment."""
        if self._tuned is not None:
            self._tuned.apply(t)
        shaped = action.reshape(self._actions.shape).astype(self._actions.dtype)
        observation, reward, terminated, truncated, _ = self._env.step(shaped)
        return Outcome(
            observation=_flat(observation),
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated) and not terminated,
            drift=0.0,
        )

    def drift(self, _t: int, /) -> float:
        """There is no target."""
        return 0.0

    def physics(self, t: int, /) -> tuple[float, ...]:
        """The factors of unit t."""
        return () if self._physics is None else self._physics.told(t)

    def position(self) -> Position:
        """MuJoCo's qpos; empty for the others."""
        if self._model is None:
            return np.empty(0)
        return np.array(self._inner.data.qpos, np.float64)

    def save_scene(self, path: Path, /) -> None:
        """Write the compiled MuJoCo model as MJB; nothing for the others."""
        if self._model is not None:
            import mujoco

            part = path.with_name(f"{path.name}.part")  # a viewer never sees half a file
            mujoco.mj_saveModel(self._model, str(part))
            part.replace(path)

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()

    def _tune(self, physics: Physics) -> ModelPhysics:
        from env_server.worlds.mujoco_physics import ModelPhysics

        assert self._model is not None, "the registry lets only the physics of MuJoCo worlds drift"
        return ModelPhysics(self._model, physics)


def _flat(observation: Any) -> Vector:
    """A copy, since some environments hand out their own memory."""
    return np.array(observation, np.float32).reshape(-1)


def _make(env_id: str, frame_skip: int | None) -> gymnasium.Env[Any, Any]:
    """The environment without its time limit (`episode_steps` rules), rendering nothing."""
    options = {} if frame_skip is None else {"frame_skip": frame_skip}
    try:
        with warnings.catch_warnings(record=True) as caught:  # such as "v4 is out of date": for the log
            warnings.simplefilter("always")
            if "mujoco" in str(gymnasium.spec(env_id).entry_point):
                _log_mujoco_warnings()
            env = gymnasium.make(env_id, max_episode_steps=-1, disable_env_checker=True, **options)
    except gymnasium.error.UnregisteredEnv as error:
        raise ConfigError("env.id", env_id, _known(env_id)) from error
    except (gymnasium.error.Error, ImportError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError("env.id", env_id, f"cannot be built here: {reason}") from error
    for warning in caught:
        _LOG.info("gymnasium: %s", warning.message)
    return env


def _known(env_id: str) -> str:
    near = difflib.get_close_matches(env_id, [*OWN_WORLDS, *gymnasium.registry], n=3)
    hint = f"; did you mean {', '.join(near)}?" if near else ""
    return f"{', '.join(OWN_WORLDS)} or a registered Gymnasium id{hint}"


def _box(env_id: str, space: gymnasium.Space[Any], what: str) -> Box:
    if not isinstance(space, Box):
        found = type(space).__name__
        raise ConfigError("env.id", env_id, f"needs a continuous (Box) {what} space, not {found}")
    return space


def _bounds(env_id: str, actions: Box) -> tuple[Vector, Vector]:
    low, high = _flat(actions.low), _flat(actions.high)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise ConfigError("env.id", env_id, "needs a bounded action space, low below high")
    return low, high


def _log_mujoco_warnings() -> None:
    """Send MuJoCo's warnings to the log.

    MuJoCo's default prints them and writes MUJOCO_LOG.TXT into the working directory, already when
    it compiles HalfCheetah, for an attribute deprecated in MuJoCo 4.0.
    """
    import mujoco

    def log(text: str) -> None:
        level = logging.DEBUG if "deprecated" in text else logging.WARNING
        _LOG.log(level, "mujoco: %s", " ".join(text.split()))

    mujoco.set_mju_user_warning(log)
