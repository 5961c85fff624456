"""Made-up lives in small finite worlds, for the tables' tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from learner.replay import Replay
from rtcore.config import ForecastConfig, LearnerConfig, TableConfig
from rtcore.spaces import Spaces
from rtcore.windows import Window

TWO_STATES = Spaces(1, 1, states=2, actions=2)
BANDIT = Spaces(1, 1, states=1, actions=2)


def table_config(
    algo: str, *, gamma: float = 0.5, forecast: dict[str, Any] | None = None, **table: Any
) -> LearnerConfig:
    """A learner of tables; `table` and `forecast` override the sections' defaults."""
    section = ForecastConfig(**({"kind": "none"} if forecast is None else {"l_p": 2} | forecast))
    fields: dict[str, Any] = {"algo": algo, "gamma": gamma, "forecast": section}
    return LearnerConfig(table=TableConfig(**table), **fields)


def live(
    replay: Replay,
    state: float,
    action: float,
    reward: float,
    after: float = 0,
    *,
    unit: int = 0,
    ends: bool = False,
) -> None:
    """Add one transition."""
    replay.add(_number(state), _number(action), reward, _number(after), ends, unit)


def pull(replay: Replay, arm: int, reward: float, *, unit: int = 0) -> None:
    """One pull in the bandit; the episode ends with it, so that Q is the reward alone."""
    live(replay, 0, arm, reward, unit=unit, ends=True)


def wander(replay: Replay, rng: np.random.Generator, transitions: int, unit: int) -> None:
    """Random transitions in the world of two states."""
    for _ in range(transitions):
        state, action, after = rng.integers(2, size=3)
        live(
            replay,
            state,
            action,
            float(rng.standard_normal()),
            after,
            unit=unit,
            ends=bool(rng.random() < 0.1),
        )


def window(m: int, start: int, update: int, hold: int | None) -> Window:
    return Window(m, start, update, hold)


def _number(value: float) -> Any:
    return np.array([value], np.float32)
