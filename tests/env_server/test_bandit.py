"""The motivating example's bandit: one state, two arms that swap."""

from __future__ import annotations

import numpy as np
import pytest

from env_server.worlds.bandit import Bandit, chance

FIRST, SECOND = np.array([0.0], np.float32), np.array([1.0], np.float32)


@pytest.mark.parametrize(("drift", "first"), [(0.0, 0.0), (0.3, 0.3), (1.0, 1.0), (-2.0, 0.0), (1.5, 1.0)])
def test_the_second_arm_pays_first_and_the_first_once_the_drift_is_one(drift: float, first: float) -> None:
    assert chance(drift, 0) == first
    assert chance(drift, 1) == 1 - first


def test_a_switch_swaps_the_arms_for_certain() -> None:
    bandit = Bandit(lambda t: float(t >= 4), seed=0)
    bandit.reset(0, 0)
    assert [bandit.step(FIRST, t).reward for t in range(8)] == [0, 0, 0, 0, 1, 1, 1, 1]
    assert [bandit.step(SECOND, t).reward for t in range(8)] == [1, 1, 1, 1, 0, 0, 0, 0]


def test_rewards_are_drawn_with_the_arms_chance() -> None:
    """1000 draws at p = 0.3: sd of the mean sqrt(0.3 * 0.7 / 1000) = 0.0145; the bound is 4 of them."""
    bandit = Bandit(lambda _: 0.3, seed=1)
    bandit.reset(1, 0)
    for arm, expected in ((FIRST, 0.3), (SECOND, 0.7)):
        rewards = [bandit.step(arm, 0).reward for _ in range(1000)]
        assert set(rewards) == {0.0, 1.0}
        assert np.mean(rewards) == pytest.approx(expected, abs=0.058)


def test_it_has_one_state_and_never_ends() -> None:
    bandit = Bandit(float, seed=0)
    assert (bandit.states, bandit.actions) == (1, 2)
    assert bandit.reset(0, 0).tolist() == [0.0]
    for t in range(50):
        outcome = bandit.step(FIRST, t)
        assert outcome.observation.tolist() == [0.0]
        assert not outcome.terminated and not outcome.truncated
        assert outcome.drift == t  # the true value, not the clipped one
