"""Which forms of the bound hold in random windows of random worlds, and which of them prefer a hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.theory import bounds, budgets, certificates, regret
from learner.theory.bounds import Start, Terms
from learner.theory.budgets import Budget
from learner.theory.certificates import Case
from tests.learner.theory.worlds import best, random_case, random_world

SEEDS = st.integers(0, 2**32 - 1)
CHANGES = st.lists(st.floats(0, 10), min_size=2, max_size=12)


def drawn(rng: np.random.Generator) -> Case:
    return random_case(rng, random_world(rng, int(rng.integers(3, 13))))


def without_e(case: Case) -> Terms:
    """`repaired` with (1 - x)^g as printed in place of (1 - x)^(g - 1): a, b and c mended alone."""
    found, last, turn = case.constants(), case.turn - 1, case.turn
    budget = case.budget(case.begin, turn, right=True)
    update = bounds.update_bound(found, case.c1(case.start(last)), case.delta(last), budget, case.update)
    hold = Terms(0.0, 0.0, 0.0)
    if case.hold:
        c1, budget = case.c1(case.start(turn)), case.budget(turn, case.end)
        hold = bounds.hold_bound(found, c1, case.delta(turn), budget, case.update, case.hold)
    return update.plus(hold)._replace(tail=2 * (case.update + case.hold) * case.world.tail)


@given(seed=SEEDS)
@settings(max_examples=250)
def test_what_is_proven_holds_in_any_world(seed: int) -> None:
    case = drawn(np.random.default_rng(seed))
    lost = certificates.measured(case)
    slack = 1e-9 * (1 + lost.sum())
    assert lost.sum() <= certificates.proven(case).total + slack
    assert (lost <= certificates.gibbs(case) + slack).all()


def test_how_many_random_windows_violate_each_form() -> None:
    # the first 1000 of the 12 000 of which learner.theory.certificates tells
    rng, broken = np.random.default_rng(0), dict.fromkeys(("printed", "without e", "repaired"), 0)
    for _ in range(1000):
        case = drawn(rng)
        lost = certificates.measured(case).sum() * (1 - 1e-9) - 1e-9
        broken["printed"] += lost > certificates.printed(case).total
        broken["repaired"] += lost > certificates.repaired(case).total
        if lost > without_e(case).total:
            broken["without e"] += 1
            assert case.eta * case.tau == pytest.approx(1 - case.world.gamma)
    assert broken["printed"] > broken["without e"] > 0  # 11 and 6
    assert broken["repaired"] == 0


def test_the_bounds_of_windows_add_up_over_a_run() -> None:
    # Algorithm 1 over four windows, each beginning with what the one before it ended with
    rng = np.random.default_rng(2)
    for _ in range(15):
        world = random_world(rng, 13)
        tau, forecast_error = 0.1, float(rng.choice([0.0, 0.3]))
        policy = np.full((world.states, world.actions), -np.log(world.actions))
        executed, bound = [], np.zeros(3)
        for begin in range(0, 12, 3):
            future = best(world, begin + 3) + forecast_error * rng.choice([-1, 1], size=policy.shape)
            case = Case(world, begin, 2, 1, policy, future, 0.3 * (1 - world.gamma) / tau, tau)
            assert case.delta(case.end) == pytest.approx(forecast_error)
            made = case.iterates()
            executed.append(regret.executed(made, 1))
            policy = made[-1]
            bound += (
                certificates.repaired(case).total,
                certificates.proven(case).total,
                certificates.gibbs(case).sum(),
            )
        lost = regret.per_unit(world, np.concatenate(executed)).sum()
        assert (lost <= bound + 1e-9).all()


# -- what the paper says of N, and what the bounds do


def test_the_gibbs_bound_prefers_no_hold_whatever_changes() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        world = random_world(rng, 9)
        case = random_case(rng, world)
        whole = [certificates.gibbs(replace(case, begin=0, update=g, hold=8 - g)).sum() for g in range(1, 9)]
        assert (np.diff(whole) <= 1e-9 * np.abs(whole[0])).all()


@given(b_r=CHANGES, b_p=CHANGES, data=st.data())
def test_with_the_error_that_budgets_allow_the_repaired_theorem_prefers_none(
    b_r: list[float], b_p: list[float], data: st.DataObject
) -> None:
    # R^f and R^env together; and so with R^pi, for one policy and one C_1
    width = min(len(b_r), len(b_p))
    changes = np.array(b_r[:width]), np.array(b_p[:width]) / 5
    gamma, share = data.draw(st.floats(0, 0.99)), data.draw(st.floats(0.01, 1))
    horizon = data.draw(st.none() | st.integers(1, 50))
    tau, r_max, start = 0.1, data.draw(st.floats(0, 10)), Start(1.0, 2.0)
    eta = share * (1 - gamma) / tau
    found = bounds.constants(gamma=gamma, eta=eta, tau=tau, actions=3, r_max=r_max, horizon=horizon)
    c1 = bounds.c1(start, gamma=gamma, eta=eta, tau=tau)

    def error(anchor: int) -> float:
        ahead = Budget(*(budgets.local(b, anchor, width) for b in changes))
        return 0.3 + bounds.optimal_gap(gamma, r_max, ahead, horizon)

    whole, policy = [], []
    for turn in range(width, 0, -1):
        late = Budget(*(budgets.cumulative_right(b, 0, turn) for b in changes))
        held = Budget(*(budgets.cumulative(b, turn, width) for b in changes))
        terms = bounds.settled_update_bound(found, start, c1, error(turn - 1), late, turn, tau)
        terms = terms.plus(bounds.settled_hold_bound(found, c1, error(turn), held, turn, width - turn))
        whole.append(terms.forecast + terms.environment)
        policy.append(terms.policy)
    assert min(whole) >= whole[0] * (1 - 1e-9)
    assert min(policy) >= policy[0] * (1 - 1e-9)
