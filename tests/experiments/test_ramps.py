"""The motivating example's exact sums, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.ramps import (
    Ramp,
    average,
    best_ramp,
    best_span,
    by_switch,
    expected_rewards,
    in_the_limit,
    rewards_given,
)


def test_a_ramp_by_hand() -> None:
    np.testing.assert_allclose(Ramp(begin=1, span=2).beta(5), [0, 0, 0.5, 1, 1])


def test_expected_rewards_by_hand() -> None:
    """T = 4: the switch has come with probability 0, 1/4, 1/2, 3/4; beta = 0, 1/2, 1, 1.

    (1 - beta)(1 - p) + beta p = 1, 3/8 + 1/8, 1/2, 3/4; their mean is 11/16.
    """
    beta = Ramp(begin=0, span=2).beta(4)
    np.testing.assert_allclose(expected_rewards(beta), [1, 0.5, 0.5, 0.75])
    assert average(beta) == pytest.approx(11 / 16)


def test_rewards_of_one_switch_by_hand() -> None:
    """beta = 0, 1/2, 1, 1; swapped from unit 2 on: a_1 pays 1 and 1/2, then a_0 pays 1 and 1."""
    beta = Ramp(begin=0, span=2).beta(4)
    np.testing.assert_allclose(rewards_given(beta, 2), [1, 0.5, 1, 1])
    np.testing.assert_allclose(rewards_given(beta, 4), [1, 0.5, 0, 0])  # it never comes


@pytest.mark.parametrize("ramp", [Ramp(0, 5), Ramp(3, 4), Ramp(9, 20)])
def test_the_mean_over_switches_is_the_expectation(ramp: Ramp) -> None:
    beta = ramp.beta(12)
    assert by_switch(beta).shape == (12,)
    assert by_switch(beta).mean() == pytest.approx(float(average(beta)))


@pytest.mark.parametrize(("begin", "span"), [(0.0, 0.25), (0.0, 1.0), (0.5, 0.5), (0.3, 0.01)])
def test_many_units_come_to_the_integral(begin: float, span: float) -> None:
    units = 20_000
    ramp = Ramp(round(begin * units), round(span * units))
    assert float(average(ramp.beta(units))) == pytest.approx(in_the_limit(begin, span), abs=2e-4)


def test_the_integral_by_hand() -> None:
    """A jump in the middle: 1/2 + 1/4; the ramp over all of T: the integral of (1 - p)^2 + p^2 is 2/3."""
    assert in_the_limit(0.5, 0.0) == pytest.approx(3 / 4)
    assert in_the_limit(0.0, 1.0) == pytest.approx(2 / 3)


def test_from_a_given_begin_a_middle_tempo_is_best() -> None:
    assert best_span(120, 0) == Ramp(0, 90)  # 3/4 of T
    assert best_span(120, 20) == Ramp(20, 60)  # 3/4 (1 - 2 / 6) of T
    assert best_span(120, 60) == Ramp(60, 1)  # from the middle on, as fast as may be


def test_no_policy_at_all_beats_a_jump_in_the_middle() -> None:
    """E is linear in each beta_t with slope 2 t / T - 1: so 0 below T / 2 and 1 above it are best.

    T = 120: max(t, 120 - t) sums to 120 + .. + 60 = 5490 and 61 + .. + 119 = 5310, so 3/4 of 120^2.
    """
    best = best_ramp(120)
    assert best.span == 1 and best.begin in (59, 60)
    assert float(average(best.beta(120))) == pytest.approx(0.75)
    others = np.random.default_rng(0).uniform(size=(500, 120)).round(1)
    assert (average(others) < 0.75).all()
