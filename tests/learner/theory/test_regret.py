"""Exact dynamic regret: by hand, and by running Algorithm 1 step by step."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from learner.tabular.table import log_normalised, npg_step
from learner.theory import certificates, regret, values
from learner.theory.mdp import TimeElapsingMdp
from rtcore.config import ConfigError
from rtcore.windows import ExplicitSchedule, FixedSchedule
from tests.learner.theory.worlds import bandit, random_case, random_world

SURE = np.array([[[1.0, 0.0]]])


def test_a_bandit_whose_arms_change_places() -> None:
    # always arm 0: nothing lost, nothing lost, then 1 a unit; always one half: half of each unit's best
    world = bandit([[1, 0], [2, 0], [0, 1], [0, 3]])
    np.testing.assert_allclose(regret.per_unit(world, np.repeat(SURE, 4, 0)), [0, 0, 1, 3])
    np.testing.assert_allclose(regret.per_unit(world, np.full((4, 1, 2), 0.5)), [0.5, 1, 0.5, 1.5])
    np.testing.assert_allclose(regret.per_unit(world, np.repeat(SURE, 2, 0), first=2), [1, 3])


def test_a_start_averages_what_is_otherwise_the_worst_state() -> None:
    # absorbing states that pay 1 for action 0: with gamma = 1/2, what never takes it loses 2
    world = TimeElapsingMdp(np.array([[[1.0, 0], [1, 0]]]), np.eye(2)[None, :, None].repeat(2, 2), 0.5)
    policy = np.array([[[1.0, 0.0], [0.0, 1.0]]])
    assert regret.per_unit(world, policy) == pytest.approx([2.0])
    assert regret.per_unit(world, policy, start=np.array([0.75, 0.25])) == pytest.approx([0.5])


def test_an_episode_of_three_steps_loses_three_rewards() -> None:
    world = TimeElapsingMdp(np.array([[[1.0, 0.0]]]), np.ones((1, 1, 2, 1)), 0.5, horizon=3)
    assert regret.per_unit(world, SURE[..., ::-1]) == pytest.approx([1.75])  # 1 + 1/2 + 1/4


def test_phases_share_the_units_between_them() -> None:
    # G = 2, N = 1: units 0 1 | 2 || 3 4 | 5 || 6
    lost = np.array([1.0, 2, 4, 8, 16, 32, 64])
    found = regret.by_phase(lost, FixedSchedule(3, 2 / 3))
    assert (found.update, found.hold) == (1 + 2 + 8 + 16 + 64, 4 + 32)
    assert found.total == lost.sum()
    # from unit 2 on: it is the first window's hold
    assert regret.by_phase(lost[:2], FixedSchedule(3, 2 / 3), first=2) == regret.PhaseRegret(2, 1)


def test_the_phases_of_the_paper_s_example() -> None:
    # t = 0, 13, 25 with G = 10, 4, 5 up to t = 29: holds are 10..12 and 17..24
    found = regret.by_phase(np.ones(30), ExplicitSchedule((0, 13, 25), (10, 4, 5)))
    assert found == regret.PhaseRegret(19, 11)


def test_a_unit_is_executed_with_what_was_made_before_it() -> None:
    made = np.log(np.array([[[0.1, 0.9]], [[0.2, 0.8]], [[0.3, 0.7]]]))  # G = 2
    np.testing.assert_allclose(regret.executed(made, 3)[:, 0, 0], [0.1, 0.2, 0.3, 0.3, 0.3])
    np.testing.assert_allclose(regret.executed(made, 0)[:, 0, 0], [0.1, 0.2])


def test_iterates_of_one_forecast_are_a_closed_form() -> None:
    # log pi^g = beta^g log pi^0 + (1 - beta^g) Q / tau - log Z, beta = 1 - eta tau / (1 - gamma) = 1 - 0.1
    rng = np.random.default_rng(0)
    policy, q = log_normalised(rng.normal(size=(3, 2))), rng.normal(size=(3, 2))
    made = regret.iterates(policy, q, 5, eta=0.1, tau=0.5, gamma=0.5)
    assert made.shape == (6, 3, 2)
    for g, found in enumerate(made):
        left = 0.9**g
        np.testing.assert_allclose(found, log_normalised(left * policy + (1 - left) * q / 0.5))


def test_a_window_s_regret_is_that_of_algorithm_1_step_by_step() -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        case = random_case(rng, random_world(rng, 8))
        world, policy, expected = case.world, case.log_policy, []
        for t in range(case.begin, case.end):
            args = world.reward[t], world.transition[t]
            options: dict[str, Any] = {"gamma": world.gamma, "horizon": world.horizon}
            gap = values.optimal(*args, **options).v - values.evaluate(*args, np.exp(policy), **options).v
            expected.append(gap.max())
            if t < case.begin + case.update:  # the update computed in t is executed in t + 1
                policy = npg_step(policy, case.forecast, eta=case.eta, entropy=case.tau, gamma=world.gamma)
        np.testing.assert_allclose(certificates.measured(case), expected, rtol=1e-9, atol=1e-9)


def test_what_no_window_makes_is_refused() -> None:
    policy, q = np.log(np.full((3, 2), 0.5)), np.zeros((3, 2))
    rates = {"eta": 0.1, "tau": 0.5, "gamma": 0.5}
    for wrong, said in (
        ({"gamma": 1.0}, "gamma = 1.0"), ({"tau": 0.0}, "tau = 0.0"), ({"eta": 1.1}, "eta = 1.1"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=said):
            regret.iterates(policy, q, 2, **(rates | wrong))
    with pytest.raises(ConfigError, match="number = -1"):
        regret.iterates(policy, q, -1, **rates)
    with pytest.raises(ConfigError, match=r"forecast.shape = \(2, 2\): must be log_policy's, \(3, 2\)"):
        regret.iterates(policy, q[:2], 2, **rates)
    with pytest.raises(ConfigError, match="hold = -1"):
        regret.executed(policy[None], -1)
    with pytest.raises(ConfigError, match=r"regret.shape = \(2, 2\)"):
        regret.by_phase(np.ones((2, 2)), FixedSchedule(3, 2 / 3))


def test_what_was_not_executed_here_is_refused() -> None:
    world = bandit([[1, 0], [0, 1]])
    with pytest.raises(ConfigError, match=r"units = \(1, 3\)"):
        regret.per_unit(world, np.repeat(SURE, 2, 0), first=1)
    with pytest.raises(ConfigError, match="units"):
        regret.per_unit(world, SURE[:0])
    with pytest.raises(ConfigError, match=r"policies.shape = \(1, 1, 3\)"):
        regret.per_unit(world, np.full((1, 1, 3), 1 / 3))
    with pytest.raises(ConfigError, match=r"policies\[0, 0\] = \[0.5, 0.6\]"):
        regret.per_unit(world, np.array([[[0.5, 0.6]]]))
    with pytest.raises(ConfigError, match="start"):
        regret.per_unit(world, SURE, start=np.array([0.5]))
