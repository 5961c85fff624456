from __future__ import annotations

from typing import Any, get_args

import pytest

from recorder.card import run_card
from rtcore.config import DriftConfig, DriftKind, EnvConfig, PhysicsConfig, RunConfig
from tests.recorder.stage import SPEC

FIELDS: dict[str, Any] = {
    "offset": 1.0, "amplitude": 0.5, "omega": 0.1, "at": 7.0, "span": 10.0, "every": 20.0, "rate": 0.2,
    "sd": 0.3, "path": "/data/target.csv",
}  # fmt: skip
WORDS: dict[DriftKind, str] = {
    "none": "none",
    "constant": "constant 1",
    "sine": "1 + 0.5 sin(0.1 t)",
    "square": "1 + 0.5 sgn(sin(0.1 t))",
    "ramp": "ramp from 1 to 1.5, over 10 units from t = 7",
    "switch": "switch from 1 to 1.5 at t = 7, back and forth every 20 units",
    "burst": "1, but 1.5 for 10 units from t = 7, every 20 units",
    "random_walk": "random walk from 1, steps of sd 0.3",
    "ou": "Ornstein-Uhlenbeck around 1, pulled by 0.2 per unit, steps of sd 0.3",
    "noise": "noise around 1, sd 0.3",
    "recorded": "recorded in `/data/target.csv`",
}


def card(**env: Any) -> str:
    return run_card("r1", RunConfig(env=EnvConfig(**env)), SPEC, {})


@pytest.mark.parametrize("kind", get_args(DriftKind))
def test_every_kind_of_drift_has_its_words(kind: DriftKind) -> None:
    assert f"| drift | {WORDS[kind]} |" in card(drift=DriftConfig(kind=kind, **FIELDS))


def test_what_else_a_drift_may_have() -> None:
    once = DriftConfig(kind="switch", amplitude=1.0, at="random", span=30.0, low=0.0, high=0.5, seed=4)
    assert "| switch from 0 to 1 at a random unit below 30, at least 0, at most 0.5, seed 4 |" in card(
        drift=once
    )
    assert "| 0 + 1 sin(2 t + 3) |" in card(drift=DriftConfig(amplitude=1.0, omega=2.0, phase=3.0))


def test_physics_and_what_is_told_stand_there_if_they_are() -> None:
    plain = card()
    assert "factor" not in plain and "told" not in plain
    heavy = card(physics=PhysicsConfig(mass=DriftConfig(kind="constant", offset=2.0)), notify="changed")
    assert "| factor on mass | constant 2 |" in heavy and "| told | when it changes |" in heavy
    assert "factor on gravity" not in heavy
    assert "| told | the drift's value |" in card(notify="value")
