"""A small world for the learner's tests: a config with little nets, and a replay of made-up transitions."""

from __future__ import annotations

from typing import Any

import numpy as np

from learner.replay import Replay
from rtcore.config import ForecastConfig, LearnerConfig

OBSERVATION_DIM, ACTION_DIM = 3, 2


def small_config(**fields: Any) -> LearnerConfig:
    """Nets of 16 x 16, batches of 32, products that formulas can be held against; `fields` override."""
    defaults: dict[str, Any] = {"hidden": (16, 16), "batch": 32, "algo": "sac", "precision": "float32"}
    return LearnerConfig(**(defaults | fields))


def forq(**fields: Any) -> ForecastConfig:
    """A forecast section; `fields` override."""
    defaults: dict[str, Any] = {"kind": "forq", "l_p": 3}
    return ForecastConfig(**(defaults | fields))


def filled_replay(transitions: int = 200, *, per_unit: int = 20, seed: int = 1) -> Replay:
    """Random transitions, `per_unit` of them in each unit, a tenth of them terminal."""
    rng = np.random.default_rng(seed)
    replay = Replay(1000, OBSERVATION_DIM, ACTION_DIM)
    for index in range(transitions):
        replay.add(
            rng.standard_normal(OBSERVATION_DIM, dtype=np.float32),
            rng.uniform(-1, 1, ACTION_DIM).astype(np.float32),
            float(rng.standard_normal()),
            rng.standard_normal(OBSERVATION_DIM, dtype=np.float32),
            bool(rng.random() < 0.1),
            index // per_unit,
        )
    return replay
