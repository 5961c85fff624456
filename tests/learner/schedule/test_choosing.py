"""The choice of a window's update and what is said of it, by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from learner.schedule.choosing import by_bound, by_forecasts, fall_back
from learner.schedule.outlook import Outlook
from rtcore.config import LearnerConfig, ScheduleConfig, TableConfig

LN3 = math.log(3.0)


def outlook(
    forecasts: list[list[float]], target: list[float], *, slope: float = 1.0, noise: float = 0.0
) -> Outlook:
    """One state, two actions, a uniform policy; past tables on a line of `slope`, or beside it."""
    times = np.array([-3.0, -2.0, -1.0, 0.0])
    past = slope * times + noise * np.array([1.0, -1.0, -1.0, 1.0])
    return Outlook(
        past=np.stack([past, np.zeros(4)], -1)[:, None],
        times=times,
        forecasts=np.array(forecasts)[:, None],
        target=np.array([target]),
        log_policy=np.full((1, 2), -math.log(2.0)),
        rate=0.5,
        temperature=1.0,
    )


def test_policies_go_half_of_what_is_left_in_each_unit() -> None:
    # target (2 ln 3, 0): log-odds 0, ln 3, 1.5 ln 3 of at most 2 ln 3
    found = outlook([[0.0, 0.0]] * 3, [2 * LN3, 0.0]).policies()
    np.testing.assert_allclose(found[:, 0, 0] / found[:, 0, 1], [1.0, 3.0, 3**1.5])


# Towards arm 0 with odds 1, 3, 3^1.5: pi(1) = .5, .25, .1614. Regret of a unit in which arm 0 is better by
# 1 is pi(1), and in which arm 1 is, 1 - pi(1).
LOSES = [0.5, 0.25, 1 / (1 + 3**1.5)]


def test_no_hold_where_the_target_stays_right() -> None:
    choice = by_forecasts(ScheduleConfig(kind="auto", l_f=2), outlook([[1.0, 0.0]] * 3, [2 * LN3, 0.0]))
    assert choice.update == 2
    assert choice.predicted == choice.unheld == pytest.approx(sum(LOSES))
    assert choice.why == "no advantage is predicted to change by more than the temperature 1"


def test_no_hold_where_what_is_right_only_grows() -> None:
    grows = outlook([[1.0, 0.0], [1.0, 0.0], [4.0, 0.0]], [2 * LN3, 0.0])
    choice = by_forecasts(ScheduleConfig(kind="auto", l_f=2), grows)
    assert choice.update == 2
    assert choice.unheld == pytest.approx(LOSES[0] + LOSES[1] + 4 * LOSES[2])
    assert choice.why == "no hold is predicted to save 5% of the regret 1.4"


def test_a_hold_where_the_target_goes_wrong() -> None:
    wrong = outlook([[2.0, 0.0], [0.0, 2.0], [0.0, 2.0]], [2 * LN3, 0.0])
    choice = by_forecasts(ScheduleConfig(kind="auto", l_f=2), wrong)
    held, unheld = 2 * (0.5 + 0.75 + 0.75), 2 * (0.5 + 0.75 + (1 - LOSES[2]))
    assert choice.update == 2
    assert choice.predicted == choice.unheld == pytest.approx(unheld)
    eager = by_forecasts(ScheduleConfig(kind="auto", l_f=2, least_gain=0.02), wrong)
    assert eager.update == 1
    assert eager.predicted == pytest.approx(held)
    assert eager.why == "predicted regret 4, 4% below 4.18 without a hold"
    assert eager.trust == 1.0


def test_no_hold_where_there_is_nothing_to_lose() -> None:
    """A policy that has arrived where forecasts go on pointing, and with whose best action they only grow."""
    sure = outlook([[2.0, 0.0], [4.0, 0.0], [9.0, 0.0]], [2000.0, 0.0])
    arrived = replace(sure, log_policy=np.array([[0.0, -2000.0]]))
    choice = by_forecasts(ScheduleConfig(kind="auto", l_f=2, least_gain=0.0), arrived)
    assert (choice.update, choice.predicted, choice.unheld) == (2, 0.0, 0.0)
    assert choice.why == "no regret is predicted"


def test_it_stays_within_its_limit() -> None:
    wrong = outlook([[1.0, 0.0], [0.0, 9.0], [0.0, 9.0]], [2 * LN3, 0.0])
    config = ScheduleConfig(kind="auto", l_f=2, least_gain=0.0, least_update=2)
    assert by_forecasts(config, wrong).update == 2


def test_no_hold_where_the_change_looks_like_noise() -> None:
    noisy = outlook([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]], [2 * LN3, 0.0], slope=0.01, noise=1.0)
    choice = by_forecasts(ScheduleConfig(kind="auto", l_f=2, least_gain=0.0), noisy)
    assert (choice.update, choice.trust) == (2, 0.0)
    assert choice.why == "the change of Q is hardly told from noise (trust 0.00)"


def test_the_bound_holds_only_where_q_changes() -> None:
    learner = LearnerConfig(algo="npg", gamma=0.5, table=TableConfig(eta=0.5, entropy=0.5))
    config = ScheduleConfig(kind="auto_bound", l_f=10)
    still = by_bound(config, outlook([[0.0, 0.0]] * 11, [1.0, 0.0], slope=0.0), learner)
    assert still.update == 10
    fast = by_bound(config, outlook([[0.0, 0.0]] * 11, [1.0, 0.0], slope=100.0), learner)
    assert fast.update == 5  # budgets alone: n (n - 1) / 2 of G and of W - G, alike
    limited = by_bound(
        ScheduleConfig(kind="auto_bound", l_f=10, least_update=7),
        outlook([[0.0, 0.0]] * 11, [1.0, 0.0], slope=100.0),
        learner,
    )
    assert limited.update == 7
    assert "Q changing by 100 a unit" in fast.why


def test_the_declared_schedule_until_enough_is_known() -> None:
    config = ScheduleConfig(kind="auto", l_f=10, gamma_f=0.35, rounding="ceil")
    choice = fall_back(config, 3, 5)
    assert (choice.update, choice.why) == (4, "as declared, for 3 of 5 past Q functions are there")
    assert math.isnan(choice.predicted)
