"""The best split of a window: by hand, against enumeration, and against finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from learner.theory.optimum import (
    HoldProblem,
    best_environment_split,
    best_policy_split,
    best_settled_split,
    best_split,
    environment_regret,
    geometric_sum,
    policy_regret,
    regret,
    settled_regret,
)
from learner.theory.stationarity import (
    closed_form_hold,
    closed_form_hold_printed,
    hold_by_equation,
    stationarity,
    stationarity_printed,
)
from rtcore.config import ConfigError

# W = 3, x = 1/2, C_1 = 8, C_4 + C_5 = 2, alpha = 2 and 3, B = 1 and 1/2.
#   N  G  R^pi = 16 (1 - 2^-G) + 8 N 2^-G   R^env = 2 (2^G - 1) + (3^N - 1) / 2   sum
#   0  3  16 * 7/8          = 14            2 * 7          = 14                    28
#   1  2  16 * 3/4 + 2      = 14            2 * 3 + 1      =  7                    21
#   2  1  16 * 1/2 + 8      = 16            2 * 1 + 4      =  6                    22
#   3  0  0 + 24            = 24            0 + 13         = 13                    37
BY_HAND = HoldProblem(
    window=3, c_1=8.0, c_45=2.0, eta=5.0, tau=0.1, alpha_1=2.0, alpha_2=3.0, b_1=1.0, b_2=0.5
)
# The one at which the corrected derivative is .476105 and the printed one .213769, at N = 7.3.
LONGER = HoldProblem(
    window=20, c_1=5.0, c_45=1.0, eta=0.2, tau=1.0, alpha_1=1.06, alpha_2=1.05, b_1=1.0, b_2=0.8
)


def draw(random: np.random.Generator, *, least_growth: float = 1.001) -> HoldProblem:
    """Any problem whose terms are of comparable size."""
    return HoldProblem(
        window=int(random.integers(1, 61)),
        c_1=float(10 ** random.uniform(-2, 2)),
        c_45=float(10 ** random.uniform(-2, 2)),
        eta=float(random.uniform(0.005, 0.995)),
        tau=1.0,
        alpha_1=float(random.uniform(least_growth, 1.3)),
        alpha_2=float(random.uniform(least_growth, 1.3)),
        b_1=float(10 ** random.uniform(-1, 1)),
        b_2=float(10 ** random.uniform(-1, 1)),
    )


def values(problem: HoldProblem, objective=regret) -> list[float]:  # type: ignore[no-untyped-def]
    return [objective(problem, hold) for hold in range(problem.window + 1)]


def test_terms_by_hand() -> None:
    assert values(BY_HAND, policy_regret) == pytest.approx([14, 14, 16, 24], rel=1e-14)
    assert values(BY_HAND, environment_regret) == pytest.approx([14, 7, 6, 13], rel=1e-14)
    assert values(BY_HAND) == pytest.approx([28, 21, 22, 37], rel=1e-14)


def test_splits_by_hand() -> None:
    split = best_split(BY_HAND)
    assert (split.hold, split.update, split.ties) == (1, 2, (1,))
    assert split.value == pytest.approx(21)
    assert split.update_share == pytest.approx(2 / 3)
    # (2 ln 2 + ln 2) / ln 6 = 1.16, so the ceiling is 2
    assert best_environment_split(BY_HAND).hold == 2


def test_geometric_sum_by_hand_and_at_its_limit() -> None:
    assert geometric_sum(2.0, 4) == pytest.approx(1 + 2 + 4 + 8)
    assert geometric_sum(0.5, 3) == pytest.approx(1.75)
    assert geometric_sum(1.0, 7) == geometric_sum(1.0 + 1e-13, 7) == 7
    # n + n (n - 1) / 2 * 1e-9: a plain (a^n - 1) / (a - 1) is 1e-7 off
    assert geometric_sum(1.0 + 1e-9, 50) == pytest.approx(50 + 1225e-9, rel=1e-13)


def test_a_policy_term_alone_has_the_tie_of_0_and_1() -> None:
    random = np.random.default_rng(1)
    for _ in range(300):
        problem = draw(random)
        found = best_policy_split(problem)
        assert found.hold == 0 and found.ties[:2] == (0, 1)
        assert policy_regret(problem, 0) == pytest.approx(policy_regret(problem, 1), rel=1e-12)
        still = best_split(replace(problem, b_1=0.0, b_2=0.0))
        assert still == found
    assert best_policy_split(BY_HAND).ties == (0, 1)


def test_the_integer_minimum_is_that_of_enumeration() -> None:
    random = np.random.default_rng(2)
    for _ in range(5000):
        problem = draw(random)
        for objective, best in ((regret, best_split), (environment_regret, best_environment_split)):
            tried = values(problem, objective)
            found = best(problem)
            assert tried[found.hold] == found.value
            assert found.value <= min(tried) * (1 + 1e-9), problem
            assert all(value > found.value * (1 - 1e-9) for value in tried[: found.hold])


def test_settled_terms_and_split_by_hand() -> None:
    # As above with G - 1 in place of G: R^pi = 16 (1 - 2^(1-G)) + 8 N 2^(1-G) = 12, 12, 16 for N = 0, 1, 2
    found = [settled_regret(BY_HAND, hold) for hold in range(3)]
    assert found == pytest.approx([12 + 14, 12 + 7, 16 + 6], rel=1e-14)
    assert best_settled_split(BY_HAND).hold == 1
    # C_1 = 3: 3/8 of the first terms, 4.5, 4.5, 6 beside 5.25, 5.25, 6, 9. A unit less of hold is best.
    softer = replace(BY_HAND, c_1=3.0)
    assert [settled_regret(softer, hold) for hold in range(3)] == pytest.approx([18.5, 11.5, 12])
    assert values(softer) == pytest.approx([19.25, 12.25, 12, 22])
    assert (best_settled_split(softer).hold, best_split(softer).hold) == (1, 2)
    assert best_settled_split(replace(BY_HAND, b_1=0.0, b_2=0.0)).ties == (0, 1)
    with pytest.raises(ConfigError, match=r"hold = 3: must be in \[0, 2\]"):
        settled_regret(BY_HAND, 3)


def test_the_settled_hold_is_that_of_enumeration_and_at_most_a_unit_shorter() -> None:
    random, shorter = np.random.default_rng(7), 0
    for _ in range(1000):
        problem = draw(random)
        tried = [settled_regret(problem, hold) for hold in range(problem.window)]
        found, printed = best_settled_split(problem), best_split(problem)
        assert tried[found.hold] == found.value <= min(tried) * (1 + 1e-9)
        assert printed.hold - found.hold in (0, 1)
        shorter += printed.hold > found.hold
        uneven = replace(problem, alpha_1=1 / problem.alpha_1)
        least = min(settled_regret(uneven, hold) for hold in range(problem.window))
        assert best_settled_split(uneven).value == least
    assert 100 < shorter < 200  # 17 % of 3000


def test_corrected_closed_form_is_right_and_the_printed_one_is_not() -> None:
    """Of {floor, floor + 1}, clipped to the window, one is the integer minimum."""
    random = np.random.default_rng(3)
    hits = {closed_form_hold: 0, closed_form_hold_printed: 0}
    for _ in range(2000):
        problem = draw(random)
        best = best_environment_split(problem)
        for form in hits:
            low = math.floor(form(problem))
            near = {min(max(hold, 0), problem.window) for hold in (low, low + 1)}
            hits[form] += min(near, key=lambda hold: environment_regret(problem, hold)) in best.ties
    assert hits[closed_form_hold] == 2000
    assert hits[closed_form_hold_printed] < 1000


def test_closed_form_by_hand_and_at_equal_growth() -> None:
    # W = 20, alpha = 1.06 and 1.05, B = 1: K = (ln 1.06 / .06) / (ln 1.05 / .05) = .971148 / .975803,
    # (20 * .0582689 + 0 - .0047817) / (.0582689 + .0487902) = 1.1605965 / .1070591 = 10.8407; printed
    # 1.1605965 / (.0487902 - .0582689) = -122.4
    problem = replace(LONGER, b_2=1.0)
    assert closed_form_hold(problem) == pytest.approx(10.8407, abs=2e-4)
    assert closed_form_hold_printed(problem) == pytest.approx(-122.4, abs=0.1)
    # alpha = 1.1 twice, B_1 / B_2 = 1.21: 10 + 2 ln 1.1 / (2 ln 1.1) = 11
    equal = replace(LONGER, alpha_1=1.1, alpha_2=1.1, b_1=1.21, b_2=1.0)
    assert closed_form_hold(equal) == pytest.approx(11.0, abs=1e-9)
    assert math.isnan(closed_form_hold_printed(equal))
    assert closed_form_hold(replace(equal, alpha_1=1.1 + 1e-9)) == pytest.approx(11.0, abs=1e-6)


def test_both_equations_by_hand() -> None:
    # BY_HAND at N = 1, G = 2: ln(1 - x) = -ln 2. Corrected 8 ((1 - 2) (-ln 2) - 1) / 4 = 2 ln 2 - 2, printed
    # 8 (0 - 1) / 4 = -2; and 2 (ln 2 / 1 * 4 - ln 3 / 2 * 1/2 * 3)
    environment = 8 * math.log(2) - 1.5 * math.log(3)
    assert stationarity(BY_HAND, 1.0) == pytest.approx(2 * math.log(2) - 2 + environment, rel=1e-14)
    assert stationarity_printed(BY_HAND, 1.0) == pytest.approx(-2 + environment, rel=1e-14)


def test_derivative_at_a_point() -> None:
    step = 1e-5
    difference = (regret(LONGER, 7.3 - step) - regret(LONGER, 7.3 + step)) / (2 * step)  # by G = W - N
    assert difference == pytest.approx(0.476105, abs=1e-6)
    assert stationarity(LONGER, 7.3) == pytest.approx(0.476105, abs=5e-7)
    assert stationarity_printed(LONGER, 7.3) == pytest.approx(0.213769, abs=5e-7)


def test_corrected_equation_against_finite_differences() -> None:
    random = np.random.default_rng(4)
    for _ in range(500):
        problem = draw(random)
        hold = float(random.uniform(0.01, 0.99)) * problem.window
        step = 1e-4
        difference = (regret(problem, hold - step) - regret(problem, hold + step)) / (2 * step)
        scale = regret(problem, hold)
        assert stationarity(problem, hold) == pytest.approx(difference, rel=1e-5, abs=1e-7 * scale)


def test_holds_by_the_two_equations() -> None:
    """Around the corrected equation's roots, or at an end, is the best hold; the printed one misses some."""
    random = np.random.default_rng(5)
    corrected = printed = 0
    for _ in range(600):
        problem = draw(random)
        best = best_split(problem).ties
        corrected += hold_by_equation(problem, stationarity) in best
        printed += hold_by_equation(problem, stationarity_printed) in best
    assert corrected == 600
    assert 400 < printed < 590


def test_budgets_that_shrink_make_an_end_the_best() -> None:
    random = np.random.default_rng(6)
    for _ in range(300):
        problem = replace(
            draw(random), alpha_1=float(random.uniform(0.5, 0.99)), alpha_2=float(random.uniform(0.5, 0.99))
        )
        found = best_environment_split(problem)
        assert found.hold in (0, problem.window)
        assert found.value == min(values(problem, environment_regret))
        assert best_split(problem).value == min(values(problem))


def test_one_budget_that_shrinks_and_one_that_grows() -> None:
    # B_1 = 1, alpha_1 = 1/2, B_2 = 1/2, alpha_2 = 2, W = 3: geo(1/2, 3 - N) + geo(2, N) / 2 is
    # 1.75, 1.5 + .5 = 2, 1 + 1.5 = 2.5, 3.5
    mixed = replace(BY_HAND, alpha_1=0.5, alpha_2=2.0, c_45=1.0)
    assert values(mixed, environment_regret) == pytest.approx([1.75, 2.0, 2.5, 3.5])
    assert best_environment_split(mixed).hold == 0


@pytest.mark.parametrize(
    ("change", "hold", "ties"),
    [
        ({"b_1": 0.0}, 0, (0,)),
        ({"b_2": 0.0}, 3, (3,)),
        ({"c_45": 0.0}, 0, (0, 1, 2, 3)),
        ({"alpha_1": 1.0, "alpha_2": 1.0}, 3, (3,)),  # B_1 = 1 a unit of update, B_2 = 1/2 one of hold
        ({"alpha_1": 1.0, "alpha_2": 1.0, "b_2": 1.0}, 0, (0, 1, 2, 3)),
        ({"alpha_1": 2.0, "alpha_2": 2.0, "b_2": 1.0}, 1, (1, 2)),  # 1 + 3 either way
        ({"window": 1, "b_2": 2.0}, 0, (0,)),
    ],
)
def test_limits_of_the_environment_term(change: dict[str, float], hold: int, ties: tuple[int, ...]) -> None:
    found = best_environment_split(replace(BY_HAND, **change))  # type: ignore[arg-type]
    assert (found.hold, found.ties) == (hold, ties)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("window", 0, "at least 1"),
        ("window", 2.5, "a whole number"),
        ("window", math.nan, "a whole number"),
        ("c_1", -1.0, "at least 0"),
        ("c_45", math.nan, "at least 0"),
        ("alpha_1", 0.0, "above 0"),
        ("alpha_2", -1.05, "above 0"),
        ("b_1", math.inf, "at least 0"),
        ("eta", 0.0, "above 0"),
        ("eta", 10.0, "eta tau must be below 1"),
        ("alpha_2", 1e100, "at most 1e[+]20"),
    ],
)
def test_a_wrong_constant_is_named(name: str, value: float, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        replace(BY_HAND, **{name: value})  # type: ignore[arg-type]
    assert str(caught.value).startswith(f"{name} = {value!r}: ")


def test_a_budget_that_overflows_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"alpha_1 = 10\.0: to the power of the window, 300, must be below"):
        replace(LONGER, alpha_1=10.0, window=300)
    assert math.isfinite(regret(replace(LONGER, alpha_1=1e10, window=26, c_45=1e20, b_1=1e20), 0))


@pytest.mark.parametrize(("name", "value"), [("alpha_1", 1.0), ("alpha_2", 0.9)])
def test_calculus_needs_growth(name: str, value: float) -> None:
    problem = replace(BY_HAND, **{name: value})  # type: ignore[arg-type]
    for form in (closed_form_hold, closed_form_hold_printed):
        with pytest.raises(ConfigError, match=rf"{name} = {value}: must be above 1"):
            form(problem)
    for equation in (stationarity, stationarity_printed):
        with pytest.raises(ConfigError, match=rf"{name} = {value}: must be above 1"):
            equation(problem, 1.0)


def test_a_hold_beyond_the_window_is_refused() -> None:
    for objective in (policy_regret, environment_regret, regret):
        with pytest.raises(ConfigError, match=r"hold = 4: must be in \[0, 3\]"):
            objective(BY_HAND, 4)
    with pytest.raises(ConfigError, match=r"b_2 = 0\.0: must be above 0"):
        closed_form_hold(replace(BY_HAND, b_2=0.0))
