"""The motivating example's scripted tempo."""

from __future__ import annotations

import numpy as np
import pytest

from learner.replay import Replay
from learner.tabular.tempo import Tempo
from rtcore.config import ConfigError
from tests.learner.tabular.lived import BANDIT, TWO_STATES, table_config, window


def tempo(begin: int, span: int) -> Tempo:
    return Tempo(table_config("tempo", tempo_begin=begin, tempo_span=span), BANDIT, 0, Replay(1, 1, 1))


def share(found: Tempo) -> float:
    probability = found.policy_arrays()["probability"]
    assert probability.shape == (1, 2) and probability.sum() == 1.0
    return float(probability[0, 0])


def test_beta_rises_from_its_beginning_over_its_span() -> None:
    found = tempo(2, 4)
    found.begin_window(window(0, 0, 10, 0), 0)
    assert share(found) == 0.0
    # iterate g is published as unit g - 1 ends, and acts from unit g on: beta = (g - 2) / 4
    changed = [(found.iterate(g), share(found)) for g in range(1, 9)]
    assert [beta for _, beta in changed] == [0.0, 0.0, 0.25, 0.5, 0.75, 1.0, 1.0, 1.0]
    # the first policy is news even though it is beta = 0
    assert [news for news, _ in changed] == [True, False, True, True, True, True, False, False]
    assert (found.policy_steps, found.gradient_steps) == (4, 0)


def test_it_holds_in_a_hold() -> None:
    found = tempo(0, 10)
    found.begin_window(window(0, 0, 2, 3), 0)
    found.iterate(1)
    found.iterate(2)
    for unit in range(5):
        found.end_unit(unit)
        found.update(improve_policy=False)
    assert share(found) == pytest.approx(0.2)
    found.begin_window(window(1, 5, 2, 3), 5)
    found.iterate(1)
    assert share(found) == pytest.approx(0.6)


def test_it_goes_on_from_a_checkpoint() -> None:
    first, second = tempo(0, 10), tempo(0, 10)
    first.begin_window(window(1, 5, 5, 0), 5)
    first.iterate(2)
    second.load(first.state())
    assert share(second) == share(first) == pytest.approx(0.7)
    assert not second.iterate(2)
    assert second.iterate(3) and share(second) == pytest.approx(0.8)
    assert second.policy_steps == 2
    np.testing.assert_equal(second.metrics()["tempo/beta"], 0.8)


def test_any_other_world_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"learner.algo = 'tempo': needs 1 state and 2 actions"):
        Tempo(table_config("tempo"), TWO_STATES, 0, Replay(1, 1, 1))
