"""The bounds in known worlds: which of them hold, and the worlds that break the others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from learner.tabular.table import log_normalised
from learner.theory import bounds, certificates, values
from learner.theory.budgets import Budget
from learner.theory.certificates import Case
from learner.theory.mdp import TimeElapsingMdp
from rtcore.config import ConfigError
from tests.learner.theory.worlds import bandit, best, best_softened

TAU = 0.01
C3 = 2 * TAU * np.log(2)  # of a bandit, gamma = 0


# -- what goes into the formulas


def test_printed_by_hand() -> None:
    # The even policy is right for t_m, where both arms pay 0: C_1 = 0. One change of 1 counts once; C_4 = 2.
    world = bandit([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]])
    case = Case(world, 0, 2, 0, np.log([[0.5, 0.5]]), best(world, 2), 0.5 / TAU, TAU)
    assert certificates.printed(case) == pytest.approx((0, 2 * C3, 2, 0))


def test_the_error_of_the_iterates_by_hand() -> None:
    # Nothing pays and the policy is even, as its iterates are. Q_tau = gamma tau log 2 / (1 - gamma) is
    # tau log 2, and the forecast is 0. C_2 = 2 * 2.5 / 0.5 * (1 + 0.5 / 0.1) = 60, C_3 = 4 tau log 2.
    world = TimeElapsingMdp(np.zeros((4, 1, 2)), np.ones((4, 1, 2, 1)), 0.5)
    case = Case(world, 0, 2, 1, np.log([[0.5, 0.5]]), np.zeros((1, 2)), 0.1 / TAU, TAU)
    entropy = TAU * np.log(2)
    assert case.delta(1) == 0
    assert case.delta_of_iterates(1) == pytest.approx(entropy)
    assert certificates.proven(case) == pytest.approx((0, 3 * 64 * entropy, 0, 0))
    assert certificates.repaired(case) == pytest.approx((0, 3 * 4 * entropy, 0, 0))


def test_gibbs_by_hand() -> None:
    # beta = 1/2: the even policy loses 1/2, then tau / (1 - beta^g) (log 2 + beta^g log 2), g = 1, 1 or 1, 2
    world = bandit([[1.0, 0.0]] * 4)
    case = Case(world, 0, 1, 2, np.log([[0.5, 0.5]]), best(world, 0), 0.5 / TAU, TAU)
    entropy = TAU * np.log(2)
    assert certificates.gibbs(case) == pytest.approx([0.5, 3 * entropy, 3 * entropy])
    longer = replace(case, update=2, hold=1)
    assert certificates.gibbs(longer) == pytest.approx([0.5, 3 * entropy, 5 / 3 * entropy])


# -- a: r_max in C_5


def _leak(p: float = 0.001, r: float = 100.0, cost: float = 0.02) -> TimeElapsingMdp:
    """Both actions leave state 0 with 2 p: in unit 0 the first to -r, the second to +r; later to both."""
    reward, moves = np.zeros((3, 3, 2)), np.zeros((3, 3, 2, 3))
    reward[:, 0, 1], reward[:, 1], reward[:, 2] = -cost, r, -r
    moves[:, 1, :, 1] = moves[:, 2, :, 2] = 1.0
    moves[:, 0] = [1 - 2 * p, p, p]
    moves[0, 0] = [[1 - 2 * p, 0, 2 * p], [1 - 2 * p, 2 * p, 0]]
    return TimeElapsingMdp(reward, moves, 0.95)


def test_without_r_max_neither_the_same_policy_gap_nor_lemma_1_holds() -> None:
    # V of the first action in unit 0: gamma 2 p (-r / (1 - gamma)) / (1 - gamma (1 - 2 p)) = -3.8 / 0.0519
    # = -73.2, later 0; printed k B_p = 0.95 / 0.05^2 * 0.002 = 0.76, with r_max 76.
    world = _leak()
    first = np.array([[1.0, 0.0], [0.5, 0.5], [0.5, 0.5]])
    own = values.evaluate(world.reward, world.transition, first, gamma=0.95).v
    assert own[1, 0] - own[0, 0] == pytest.approx(3.8 / 0.0519, rel=1e-6)
    change = Budget(0.0, 0.002)
    assert bounds.same_policy_gap(0.95, 100.0, change, printed=True) == pytest.approx(0.76)
    assert bounds.same_policy_gap(0.95, 100.0, change) == pytest.approx(76.0)
    # The second action gains in unit 0 what the first loses: 146 together. C_5 B_p is 0.76 + 80 as printed,
    # 76 + 80 with r_max.
    case = Case(world, 0, 2, 0, best_softened(world, 1, 0.001), best(world, 1), 50.0, 0.001)
    lost = certificates.measured(case).sum()
    assert lost == pytest.approx(146, abs=1)
    found = certificates.repaired(case)
    assert found.environment == pytest.approx(156)
    assert lost <= found.total
    assert found.total - found.environment < 1
    assert case.constants(printed=True).c5 * 0.002 == pytest.approx(80.76)
    assert lost > found.total - found.environment + 80.76


# -- b: which end of the update phase the budgets are anchored at


def test_a_change_late_in_the_update_phase_breaks_the_printed_lemma_1() -> None:
    # The arms change places with the phase's last unit, and the policy is right for it from the beginning, so
    # 9 units lose 1. As printed the change counts once, anchored on the right 9 times; C_4 = 2, C_1 = 0.
    world = bandit([[1.0, 0.0]] * 9 + [[0.0, 1.0]] * 2)
    case = Case(world, 0, 10, 0, best_softened(world, 9, TAU), best(world, 10), 1 / TAU, TAU)
    assert certificates.measured(case).sum() == pytest.approx(9)
    assert certificates.printed(case).total == pytest.approx(2 + 10 * C3)  # 2.14
    assert certificates.repaired(case) == pytest.approx((0, 10 * C3, 18, 0))  # 18.14
    assert certificates.proven(case).total == pytest.approx(18 + 10 * C3)


# -- c: which units the forecast's error and C_1 are of


def test_a_change_at_the_window_s_end_breaks_the_printed_theorem() -> None:
    # The arms change places at t_{m+1}, as is foreseen exactly: delta as printed is 0. The first unit is
    # played right, the other 9 for the future. At the anchor t_m + 9 the forecast is off by 1; C_2 = 4.
    world = bandit([[1.0, 0.0]] * 10 + [[0.0, 1.0]])
    case = Case(world, 0, 10, 0, best_softened(world, 0, TAU), best(world, 10), 1 / TAU, TAU)
    assert case.delta(10) == 0
    assert certificates.measured(case).sum() == pytest.approx(9)
    assert certificates.printed(case).total == pytest.approx(10 * C3)  # 0.14
    assert certificates.repaired(case) == pytest.approx((0, 10 * (4 + C3), 0, 0))
    # the same with a hold: G = 2, N = 8. Lemma 2 is anchored at t_m + 2.
    held = replace(case, update=2, hold=8)
    assert certificates.measured(held).sum() == pytest.approx(9)
    assert certificates.printed(held).total == pytest.approx(10 * C3)
    assert certificates.repaired(held).total == pytest.approx(10 * (4 + C3))


def test_a_square_wave_breaks_the_printed_theorem_in_a_chain() -> None:
    # five cells in a row, left and right; the end that pays 1 changes at t_{m+1}
    moves, reward = np.zeros((5, 2, 5)), np.zeros((21, 5, 2))
    for s in range(5):
        moves[s, 0, max(s - 1, 0)] = moves[s, 1, min(s + 1, 4)] = 1.0
    reward[:20, 0], reward[20:, 4] = 1.0, 1.0
    world = TimeElapsingMdp(reward, np.repeat(moves[None], 21, 0), 0.9)
    case = Case(world, 0, 20, 0, best_softened(world, 0, 0.01), best(world, 20), 10.0, 0.01)
    lost = certificates.measured(case).sum()
    assert lost > 2 * certificates.printed(case).total
    assert lost <= certificates.repaired(case).total


# -- e: what exponent the convergence has


def test_a_sure_wrong_policy_breaks_lemma_1_even_where_nothing_changes() -> None:
    # gamma = 0 and eta = 1 / tau: C_1 = 0, as one step is all it takes. But in t_m it is not made yet.
    world = bandit([[1, 0]] * 2)
    policy = np.log([[1e-6, 1 - 1e-6]])
    case = Case(world, 0, 1, 0, policy, best(world, 0), 1 / TAU, TAU)
    assert certificates.measured(case).sum() == pytest.approx(1, abs=1e-5)
    start = case.start(0)
    lemma = bounds.update_bound(case.constants(), case.c1(start), 0.0, case.budget(0, 1, right=True), 1)
    assert lemma.total == pytest.approx(C3)
    # C_0 = tau max |log pi* - log pi|: pi* is (1, e^-100) and nearly so, at the second action -100 - 0
    assert certificates.repaired(case) == pytest.approx((TAU * 100, C3, 0, 0), rel=1e-5)


# -- f: a forecast that stays the same is not the value of a policy that moves


def _return_to_err() -> Case:
    """State 0: back to state 1, or out for good, 0.3 worse. State 1, then 0: right, or wrong, 1 worse.

    The policy is wrong in state 1, and mostly goes out. It learns to go back long before it is ever right.
    """
    reward, moves = np.zeros((3, 2)), np.zeros((3, 2, 3))
    reward[0, 1], reward[1, 1] = -0.3, -1.0
    moves[0, 0, 1] = moves[0, 1, 2] = 1.0
    moves[1, :, 0] = moves[2, :, 2] = 1.0
    world = TimeElapsingMdp(np.repeat(reward[None], 241, 0), np.repeat(moves[None], 241, 0), 0.99)
    policy = log_normalised(np.array([[-3.0, 0.0], [-100.0, 0.0], [0.0, 0.0]]))
    eta = 11 / 0.3 * 0.01 / 40  # 40 steps move state 0 from -3 to +8, and state 1 from -100 to -63
    return Case(world, 0, 40, 200, policy, best(world, 0), eta, 1e-5)


def test_a_fixed_forecast_breaks_the_repaired_theorem_though_perfect_in_a_still_world() -> None:
    case = _return_to_err()
    assert case.delta(0) == 0
    lost = certificates.measured(case)
    # state 1 every other step: 1 / (1 - gamma^2) = 50.3 where it was 1.35 before anything was learned
    assert lost[0] == pytest.approx(1.35, abs=0.01)
    assert 49 < lost[-1] < 1 / (1 - 0.99**2)
    assert lost.sum() > 4 * certificates.repaired(case).total
    assert lost.sum() > 4 * certificates.printed(case).total
    assert lost.sum() <= certificates.proven(case).total
    assert (lost <= certificates.gibbs(case)).all()


# -- what the paper says of N, and what the better bound does


def test_the_repaired_theorem_can_prefer_a_hold() -> None:
    # A drift: an update phase is compared with its last unit, a hold with its first. What is summed grows
    # with the square of a phase, so it is least where both are as long.
    world = bandit([[t / 8, 0] for t in range(-4, 5)])
    case = Case(world, 0, 8, 0, best_softened(world, 4, 1.0), best(world, 8), 1.0, 1.0)
    found = [certificates.repaired(replace(case, update=g, hold=8 - g)).environment for g in range(1, 9)]
    # C_4 = 2, b = 1/8: G (G - 1) / 8 + N (N - 1) / 8
    assert found == pytest.approx([(g * (g - 1) + (8 - g) * (7 - g)) / 8 for g in range(1, 9)])
    assert np.argmin(found) == 3


def test_a_finite_horizon_pays_for_its_tail() -> None:
    world = TimeElapsingMdp(np.ones((4, 1, 2)), np.ones((4, 1, 2, 1)), 0.5, horizon=2)
    case = Case(world, 0, 2, 1, np.log([[0.5, 0.5]]), best(world, 0), 0.5, 0.1)
    assert certificates.repaired(case).tail == pytest.approx(3 * 2 * 0.25 / 0.5)


def test_what_is_no_window_is_refused() -> None:
    world = bandit([[1, 0]] * 5)
    good = Case(world, 0, 3, 1, np.log([[0.5, 0.5]]), np.zeros((1, 2)), 1.0, 0.1)
    wrongs: list[dict[str, Any]] = [{"update": 0}, {"hold": -1}, {"begin": -1}, {"hold": 2}]
    for wrong in wrongs:
        with pytest.raises(ConfigError, match="begin, update, hold"):
            replace(good, **wrong)
    with pytest.raises(ConfigError, match="eta = 11"):
        replace(good, eta=11.0)
    with pytest.raises(ConfigError, match="forecast"):
        replace(good, forecast=np.full((1, 2), np.nan))
    with pytest.raises(ConfigError, match=r"log_policy.*finite"):
        replace(good, log_policy=np.array([[0.0, -np.inf]]))
    with pytest.raises(ConfigError, match="log_policy"):
        replace(good, log_policy=np.zeros((2, 2)))
    with pytest.raises(
        ConfigError, match=r"exp\(log_policy\)\[0\] = \[1.0, 1.0\]: must be >= 0 and sum to 1"
    ):
        replace(good, log_policy=np.zeros((1, 2)))
