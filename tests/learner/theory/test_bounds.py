"""The formulas of Lemmas 1 and 2, Theorem 1 and what is put in their place, with numbers by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from learner.tabular.table import log_normalised
from learner.theory import bounds, budgets, regret, values
from learner.theory.bounds import Constants, Start, Terms
from learner.theory.budgets import Budget
from learner.theory.mdp import TimeElapsingMdp
from rtcore.config import ConfigError
from tests.learner.theory.worlds import random_world

SOME: dict[str, Any] = {"gamma": 0.5, "eta": 0.1, "tau": 0.5, "actions": 2, "r_max": 2.0, "horizon": 2}


def test_constants_by_hand() -> None:
    # x = 0.05, h = 1 + 0.5, k = 0 + 0.5
    # C_2 = 2 * 2.5 / 0.5 * (1 + 0.5 / 0.05), C_5 = 0.5 * 2 + 1.5 * 2 / 0.5
    found = bounds.constants(**SOME)
    assert found == pytest.approx((0.05, 110.0, 2 * math.log(2), 3.0, 7.0))
    assert bounds.constants(**SOME, printed=True) == pytest.approx((0.05, 110.0, 2 * math.log(2), 3.0, 6.5))


def test_c1_by_hand_and_never_negative() -> None:
    # 2.5 * (1 + 2 * 0.5 * (1 - 0.05 / 0.5) * 2); with the bracket as printed a log ratio of 200 gives
    # 1 + 2 * 0.5 * (1 - 0.1 * 200) = -18 in place of 181
    assert bounds.c1(Start(1.0, 2.0), gamma=0.5, eta=0.1, tau=0.5) == pytest.approx(7.0)
    assert bounds.c1(Start(1.0, 200.0), gamma=0.5, eta=0.1, tau=0.5) == pytest.approx(2.5 * 181)
    assert bounds.c1(Start(1.0, 200.0), gamma=0.5, eta=1.0, tau=0.5) == pytest.approx(2.5)  # the largest eta


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"eta": 1.01}, "eta = 1.01: must be in (0, (1 - gamma) / tau] = (0, 1]"),
        ({"eta": 0.0}, "eta = 0.0: must be in"),
        ({"tau": 0.0}, "tau = 0.0: must be > 0"),
        ({"gamma": 1.0}, "gamma = 1.0: must be in [0, 1)"),
        ({"actions": 0}, "actions = 0: must be >= 1"),
        ({"r_max": -1.0}, "r_max = -1.0: must be >= 0"),
        ({"r_max": math.nan}, "r_max = nan: must be >= 0"),
        ({"horizon": 0}, "horizon = 0: must be"),
    ],
)
def test_constants_that_cannot_be_are_refused(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        bounds.constants(**(SOME | wrong))
    assert said in str(refused.value)


PLAIN = Constants(x=0.5, c2=3.0, c3=0.25, c4=2.0, c5=7.0)
CHANGED = Budget(1.5, 0.5)


def test_the_lemmas_by_hand() -> None:
    # Lemma 1: C_1 (1 - 1/4) / (1/2) = 8 * 1.5; 2 * (3 * 0.1 + 0.25); 2 * 1.5 + 7 * 0.5
    # Lemma 2: 8 / 4 for each of 3 units; 0.55 likewise
    assert bounds.update_bound(PLAIN, 8.0, 0.1, CHANGED, 2) == pytest.approx((12.0, 1.1, 6.5, 0.0))
    assert bounds.hold_bound(PLAIN, 8.0, 0.1, CHANGED, 2, 3) == pytest.approx((6.0, 1.65, 6.5, 0.0))
    # Theorem 1: 16 + (3 * 8 - 16) / 4
    assert bounds.theorem1(PLAIN, 8.0, 0.1, CHANGED, 2, 3) == pytest.approx((18.0, 2.75, 6.5, 0.0))


@pytest.mark.parametrize("update", [0, 1, 7])
@pytest.mark.parametrize("hold", [0, 1, 7])
def test_the_theorem_is_the_sum_of_the_lemmas(update: int, hold: int) -> None:
    lemmas = bounds.update_bound(PLAIN, 8.0, 0.1, CHANGED, update).plus(
        bounds.hold_bound(PLAIN, 8.0, 0.1, Budget(0.25, 2.0), update, hold)
    )
    whole = bounds.theorem1(PLAIN, 8.0, 0.1, Budget(1.75, 2.5), update, hold)
    assert whole == pytest.approx(lemmas)
    assert whole.total == pytest.approx(whole.policy + whole.forecast + whole.environment)


def test_the_exponents_that_convergence_has() -> None:
    # C_0 = 1 + 0.5 * 4, then 8 (1 + 1/2) for pi^1 and pi^2 where Lemma 1 has 8 (1 + 1/2 + 1/4) for all three
    found = bounds.settled_update_bound(PLAIN, Start(1.0, 4.0), 8.0, 0.1, CHANGED, 3, 0.5)
    assert found == pytest.approx((3.0 + 12.0, 1.65, 6.5, 0.0))
    assert bounds.settled_update_bound(PLAIN, Start(1.0, 4.0), 8.0, 0.1, CHANGED, 1, 0.5).policy == 3.0
    assert bounds.settled_hold_bound(PLAIN, 8.0, 0.1, CHANGED, 2, 3) == pytest.approx((12.0, 1.65, 6.5, 0.0))


def test_a_total_counts_what_the_horizon_may_add() -> None:
    assert Terms(1.0, 2.0, 4.0, 8.0).total == 15.0


def test_the_gaps_between_two_units_by_hand() -> None:
    # gamma = 1/2, H = 2: h = 1.5, k = 0.5. Q*: 1.5 (3 + 4 / 0.5 * 0.25); V^pi: 1.5 * 3 + 0.5 * 4 * 0.25
    change = Budget(3.0, 0.25)
    assert bounds.optimal_gap(0.5, 4.0, change, 2) == pytest.approx(7.5)
    assert bounds.same_policy_gap(0.5, 4.0, change, 2) == pytest.approx(5.0)
    assert bounds.same_policy_gap(0.5, 4.0, change, 2, printed=True) == pytest.approx(4.625)


def test_phases_that_cannot_be_are_refused() -> None:
    for update, hold, said in ((-1, 1, "update = -1: must be >= 0"), (1, -1, "hold = -1: must be >= 0")):
        for bound in (bounds.hold_bound, bounds.theorem1):
            with pytest.raises(ConfigError, match=said):
                bound(PLAIN, 8.0, 0.1, CHANGED, update, hold)
    with pytest.raises(ConfigError, match="update = -1: must be >= 0"):
        bounds.update_bound(PLAIN, 8.0, 0.1, CHANGED, -1)
    with pytest.raises(ConfigError, match="update = 0: must be >= 1"):
        bounds.settled_update_bound(PLAIN, Start(1.0, 4.0), 8.0, 0.1, CHANGED, 0, 0.5)
    with pytest.raises(ConfigError, match="update = 0: must be >= 1"):
        bounds.settled_hold_bound(PLAIN, 8.0, 0.1, CHANGED, 0, 1)
    with pytest.raises(ConfigError, match="hold = -1: must be >= 0"):
        bounds.settled_hold_bound(PLAIN, 8.0, 0.1, CHANGED, 2, -1)
    for delta in (-0.1, math.nan):
        with pytest.raises(ConfigError, match=r"delta = .*: must be >= 0"):
            bounds.theorem1(PLAIN, 8.0, delta, CHANGED, 2, 3)


def test_no_random_mdps_are_further_apart_than_their_budgets() -> None:
    rng, printed_broken = np.random.default_rng(0), 0
    for _ in range(1000):
        world = random_world(rng, 2)
        options: dict[str, Any] = {"gamma": world.gamma, "horizon": world.horizon}
        best = values.optimal(world.reward, world.transition, **options).q
        policy = np.exp(log_normalised(rng.normal(size=best.shape[1:]) * 10))
        own = values.evaluate(world.reward, world.transition, policy, **options).v
        change = Budget(float(budgets.reward_changes(world)[0]), float(budgets.transition_changes(world)[0]))
        args = (world.gamma, world.r_max, change, world.horizon)
        same = np.abs(own[1] - own[0]).max()
        assert np.abs(best[1] - best[0]).max() <= bounds.optimal_gap(*args) + 1e-9
        assert same <= bounds.same_policy_gap(*args) + 1e-9
        printed_broken += same > bounds.same_policy_gap(*args, printed=True) + 1e-9
    assert printed_broken > 0


# -- the bound that needs no convergence


def test_the_gibbs_bound_by_hand() -> None:
    # beta = 1 - 0.5 * 0.5 / 0.5 = 0.5. g = 1: (2 * 0.1 + 0.5 / 0.5 * (log 2 + 0.5 * 2 log 2)) / 0.5
    found = bounds.gibbs_bound(
        np.array([0.1, 0.0]),
        np.array([1, 2]),
        np.full(2, 2 * math.log(2)),
        gamma=0.5,
        eta=0.5,
        tau=0.5,
        actions=2,
    )
    # g = 2: 0.5 / 0.75 * (log 2 + 0.25 * 2 log 2) / 0.5 = 2 log 2
    assert found == pytest.approx([0.4 + 4 * math.log(2), 2 * math.log(2)])


def test_the_gibbs_bound_is_of_made_policies() -> None:
    with pytest.raises(ConfigError, match="step"):
        bounds.gibbs_bound(np.zeros(1), np.zeros(1), np.ones(1), gamma=0.5, eta=0.5, tau=0.5, actions=2)


def test_the_gibbs_bound_holds_in_any_mdp_for_any_forecast() -> None:
    rng, ratios = np.random.default_rng(1), []
    for _ in range(150):
        world = TimeElapsingMdp(rng.normal(size=(1, 4, 3)), rng.dirichlet([0.3] * 4, size=(1, 4, 3)), 0.9)
        tau = 10 ** rng.uniform(-2, 0)
        eta = rng.choice([0.05, 0.3, 1.0]) * 0.1 / tau
        q = values.optimal(world.reward[0], world.transition[0], gamma=0.9).q
        forecast = q + rng.choice([0.0, 0.1, 1.0]) * rng.normal(size=q.shape)
        policy = log_normalised(rng.normal(size=q.shape) * 3)
        made = regret.iterates(policy, forecast, 6, eta=eta, tau=tau, gamma=0.9)[1:]
        surprise = (-policy[np.arange(4), q.argmax(-1)]).max()
        bound = bounds.gibbs_bound(
            np.abs(forecast - q).max(), np.arange(1, 7), surprise, gamma=0.9, eta=eta, tau=tau, actions=3
        )
        lost = [regret.per_unit(world, np.exp(log)[None])[0] for log in made]
        ratios.append((lost / bound).max())
    assert 0.1 < max(ratios) <= 1.0
