"""The paper's Algorithm 1 through the learner's calls, by hand.

gamma = 1/2, tau = 1, eta = 1/4: a step is pi' = sqrt(pi) exp(Q / 2) / Z. With Q = (2 ln 3, 0) the ratio
r = pi(0) / pi(1) goes r -> 3 sqrt(r): from uniform 1 to 3, 3^1.5, 3^1.75, and so on towards 9.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from learner.replay import Replay
from learner.tabular.npg import Npg
from tests.learner.tabular.lived import BANDIT, pull, table_config, window

PAYS = 2 * math.log(3)


def lived(rewards: tuple[float, ...] = (PAYS,), **fields: object) -> tuple[Npg, Replay]:
    """One unit for each reward of arm 0; none of them in a window."""
    replay = Replay(100, 1, 1)
    table = {"step_size": 1.0, "epsilon": 0.0, "eta": 0.25, "entropy": 1.0} | fields
    found = Npg(table_config("npg", **table), BANDIT, 0, replay)  # type: ignore[arg-type]
    for unit, reward in enumerate(rewards):
        pull(replay, 0, reward, unit=unit)
        found.update(improve_policy=True)
        found.end_unit(unit)
    return found, replay


def ratio(found: Npg) -> float:
    probability = found.policy_arrays()["probability"][0]
    assert probability.sum() == pytest.approx(1.0)
    return float(probability[0] / probability[1])


def test_it_begins_uniform_and_moves_in_iterates_only() -> None:
    found, _ = lived()
    assert ratio(found) == 1.0
    assert (found.gradient_steps, found.policy_steps) == (1, 0)
    assert not found.iterate(1)  # no window yet


def test_a_window_with_its_hold() -> None:
    found, replay = lived()
    found.begin_window(window(0, 1, 2, 2), 1)
    assert found.iterate(1)
    assert ratio(found) == pytest.approx(3.0)
    assert not found.iterate(1)
    pull(replay, 0, -100.0, unit=1)  # what is learned meanwhile changes Q, but not what is climbed
    found.update(improve_policy=True)
    found.end_unit(1)
    assert found.iterate(2)
    assert ratio(found) == pytest.approx(3**1.5)
    found.end_unit(2)
    pull(replay, 0, 0.0, unit=3)
    found.update(improve_policy=False)
    found.end_unit(3)
    found.end_unit(4)
    assert ratio(found) == pytest.approx(3**1.5)
    assert (found.gradient_steps, found.policy_steps) == (3, 2)
    found.begin_window(window(1, 5, 2, 2), 5)
    assert found.iterate(1)
    assert ratio(found) == pytest.approx(3**0.75)  # towards Q = (0, 0) now: sqrt(3^1.5)
    assert found.policy_steps == 3


def test_iterates_that_nobody_asked_for_are_not_made_up_for() -> None:
    found, _ = lived()
    found.begin_window(window(0, 1, 5, 0), 1)
    found.iterate(1)
    assert found.iterate(3)  # an operator held the policy in the unit before
    assert ratio(found) == pytest.approx(3**1.5)
    assert found.policy_steps == 2


def test_a_window_entered_again_goes_on_with_its_iterates() -> None:
    found, _ = lived()
    found.begin_window(window(0, 1, 5, 0), 1)
    found.iterate(1)
    found.iterate(2)
    found.begin_window(window(0, 1, 5, 0), 3)
    assert not found.iterate(2)
    assert ratio(found) == pytest.approx(3**1.5)


def test_it_climbs_the_forecast() -> None:
    # Q(0) was 0 at t = 1 and PAYS / 4 at t = 2; the line is at PAYS when t = 5
    found, _ = lived((0.0, PAYS / 4), forecast={})
    found.begin_window(window(0, 2, 2, 1), 2)
    found.iterate(1)
    assert ratio(found) == pytest.approx(3.0)
    assert found.metrics()["forecast/snapshots"] == 2


def test_before_anything_was_learned_it_stays_uniform() -> None:
    found, _ = lived((), forecast={})
    found.begin_window(window(0, 0, 2, 0), 0)
    assert found.iterate(1)
    assert ratio(found) == 1.0


def test_what_is_published_explores_and_what_is_improved_does_not() -> None:
    found, _ = lived(epsilon=0.2)
    found.begin_window(window(0, 1, 2, 2), 1)
    found.iterate(1)
    np.testing.assert_allclose(
        found.policy_arrays()["probability"], [[0.7, 0.3]], rtol=1e-6
    )  # 0.8 * 3/4 + 0.1
    found.iterate(2)
    share = 3**1.5 / (1 + 3**1.5)
    np.testing.assert_allclose(found.policy_arrays()["probability"][0, 0], 0.8 * share + 0.1, rtol=1e-6)
