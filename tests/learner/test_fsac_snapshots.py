"""Which critics FSAC keeps, and how far ahead it reads the line through them."""

from __future__ import annotations

from typing import Literal

import pytest
import torch

from learner.deep.fsac import Fsac
from rtcore.windows import Window
from tests.learner.formulas import critic_value
from tests.learner.fsac_student import (
    WINDOW_0,
    WINDOW_1,
    climbed,
    learn_units,
    live_value,
    make_fsac,
    probe,
    times,
)
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM, filled_replay, forq, small_config


def test_it_uses_the_snapshots_there_are() -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forq(l_p=10)))
    fsac.begin_window(WINDOW_0, 0)
    assert fsac.metrics()["forecast/snapshots"] == 0
    torch.testing.assert_close(climbed(fsac), live_value(fsac))
    learn_units(fsac, range(2))
    fsac.begin_window(WINDOW_1, 4)
    assert fsac.metrics()["forecast/snapshots"] == 2


def test_critics_that_have_not_learnt_are_not_kept() -> None:
    fsac = make_fsac()
    fsac.end_unit(0)
    assert times(fsac) == []
    fsac.update(improve_policy=True)
    fsac.end_unit(1)
    assert times(fsac) == [2]


def test_a_unit_that_ends_again_replaces_what_came_after() -> None:
    fsac = make_fsac()
    learn_units(fsac, range(3))
    fsac.end_unit(1)
    assert times(fsac) == [1, 2]


@pytest.mark.parametrize(
    ("entered", "configured", "horizon"),
    [
        (Window(m=1, start=4, update=3, hold=2), "window", 5.0),
        (Window(m=1, start=4, update=3, hold=None), "window", 3.0),
        (Window(m=1, start=4, update=3, hold=2), 12.5, 12.5),
    ],
)
def test_the_horizon(entered: Window, configured: float | Literal["window"], horizon: float) -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forq(horizon=configured)))
    learn_units(fsac, range(4))
    fsac.begin_window(entered, 4)
    assert fsac.metrics()["forecast/horizon"] == horizon


def test_snapshots_are_kept_every_so_many_units() -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forq(every=3, l_p=2)))
    fsac.begin_window(WINDOW_0, 0)
    learn_units(fsac, range(10))
    assert times(fsac) == [6, 9]
    fsac.begin_window(Window(m=1, start=10, update=3, hold=1), 10)
    # the line through -4 and -1, read at 4: (-5/3, 8/3)
    assert fsac._forecast is not None
    assert fsac._forecast.weights == pytest.approx((-5 / 3, 8 / 3))
    assert fsac._forecast.before.time == 10  # the newest snapshot is not the critic at t_m
    torch.testing.assert_close(
        critic_value(fsac._forecast.before.parameters, *probe()), live_value(fsac), rtol=0, atol=0
    )


@pytest.mark.parametrize(
    ("fields", "age"),
    [
        ({}, 10 - (4.5 + 0.5)),  # units 0..9, ten transitions in each
        ({"replay_units": 1.0}, 10 - (8.5 + 0.5)),
        ({"replay_recency": 1e9, "replay_units": 2.0}, 10 - ((8.5 + 7) / 2 + 0.5)),  # 8 and 9, and 7
    ],
)
def test_the_horizon_counts_the_age_of_the_replay(fields: dict[str, float], age: float) -> None:
    config = small_config(algo="fsac", forecast=forq(horizon="replay"), **fields)
    fsac = Fsac(config, OBSERVATION_DIM, ACTION_DIM, 3, filled_replay(100, per_unit=10))
    learn_units(fsac, range(9, 10))
    fsac.begin_window(Window(m=1, start=10, update=3, hold=1), 10)
    assert fsac.metrics()["forecast/horizon"] == pytest.approx(4 + age)
