"""FSAC as the paper's authors' public code arranges it: a history of references to the live critics."""

from __future__ import annotations

from typing import Literal

import pytest
import torch

from learner.deep.fsac import Fsac
from learner.deep.sac import Sac
from rtcore.config import LearnerConfig
from rtcore.windows import Window
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM, filled_replay, forq, small_config

UPDATES_A_UNIT, LENGTH = 10, 4


def config(parity: Literal["none", "authors"]) -> LearnerConfig:
    return small_config(algo="fsac", forecast=forq(parity=parity, l_p=2, every=2))


def make(cls: type[Sac], learner: LearnerConfig, seed: int = 3) -> Sac:
    return cls(learner, OBSERVATION_DIM, ACTION_DIM, seed, filled_replay())


def learn(student: Sac, units: range) -> None:
    """Windows of four units, three of them updated."""
    for unit in units:
        if unit % LENGTH == 0:
            student.begin_window(Window(m=unit // LENGTH, start=unit, update=LENGTH - 1, hold=1), unit)
        for _ in range(UPDATES_A_UNIT):
            student.update(improve_policy=unit % LENGTH < LENGTH - 1)
        student.end_unit(unit)


def actor_of(student: Sac) -> torch.Tensor:
    return student._actor.flat


def test_a_history_of_aliases_is_sac() -> None:
    sac, fsac = make(Sac, small_config()), make(Fsac, config("authors"))
    for student in (sac, fsac):
        learn(student, range(200))
        assert student.gradient_steps == 2000
    # times -2 and 0, read at 4: w = (-2, 3), of both signs, but they sum to 1
    assert fsac.metrics()["forecast/weight_norm"] == pytest.approx(13**0.5)
    wanted, found = sac.state().tensors, fsac.state().tensors
    assert wanted.keys() == found.keys()
    for name, value in wanted.items():
        # a sum of multiples in float64 rounds back to the float32 that they are of: bit for bit here
        torch.testing.assert_close(
            torch.from_numpy(found[name]), torch.from_numpy(value), rtol=1e-6, atol=1e-7
        )


def test_a_history_of_true_copies_is_not() -> None:
    sac, fsac = make(Sac, small_config()), make(Fsac, config("none"))
    for student in (sac, fsac):
        learn(student, range(30))
    assert fsac.metrics()["forecast/snapshots"] == 2
    assert (actor_of(fsac) - actor_of(sac)).abs().max() > 1e-3


def test_a_history_of_aliases_outlives_the_process() -> None:
    before, after = make(Fsac, config("authors")), make(Fsac, config("authors"), seed=8)
    learn(before, range(10))
    after.load(before.state())
    for student in (before, after):
        learn(student, range(10, 20))
    assert torch.equal(actor_of(after), actor_of(before))
    assert after.metrics() == pytest.approx(before.metrics())
