"""The paper's calculus for the hold N (section 5): a closed form and an equation, as printed and corrected.

`learner.theory.optimum` finds the same integers without calculus; these are for comparison, and need budgets
that grow: alpha_1, alpha_2 > 1, as Assumption 1 has them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from learner.theory.optimum import ONE, HoldProblem, regret
from rtcore.config import ConfigError

Equation = Callable[[HoldProblem, float], float]


def closed_form_hold(problem: HoldProblem) -> float:
    """The real N of the least R^env (lemma on R^env, corrected), not clipped to the window.

    d R^env / dN = 0 says ln(alpha_1) / (alpha_1 - 1) B_1 alpha_1^(W - N) = ln(alpha_2) / (alpha_2 - 1) B_2
    alpha_2^N, so (alpha_1 alpha_2)^N = K alpha_1^W B_1 / B_2 with K the ratio of the two first factors, and

        N = (W ln alpha_1 + ln(B_1 / B_2) + ln K) / (ln alpha_1 + ln alpha_2)

    For alpha_1 = alpha_2 = a it is W / 2 + ln(B_1 / B_2) / (2 ln a).

    Raises:
        ConfigError: an alpha is not above 1, or a B is 0.
    """
    return _log_ratio(problem) / (math.log(problem.alpha_1) + math.log(problem.alpha_2))


def closed_form_hold_printed(problem: HoldProblem) -> float:
    """The same as printed, with ln(alpha_2 / alpha_1) below: N solves another equation. NaN where the alphas
    are equal, because it divides by 0.

    Raises:
        ConfigError: as `closed_form_hold`.
    """
    above, below = _log_ratio(problem), math.log(problem.alpha_2 / problem.alpha_1)
    return math.nan if abs(below) < ONE else above / below


def stationarity(problem: HoldProblem, hold: float) -> float:
    """The derivative of R^pi + R^env by G at a real N in [0, W] (theorem on (G, N), corrected).

        C_1 ((N - 1 / x) ln(1 - x) - 1) (1 - x)^G
          + (C_4 + C_5) (ln alpha_1 / (alpha_1 - 1) B_1 alpha_1^G - ln alpha_2 / (alpha_2 - 1) B_2 alpha_2^N)

    Raises:
        ConfigError: an alpha is not above 1.
    """
    return _equation(problem, hold, 1.0 / problem.rate)


def stationarity_printed(problem: HoldProblem, hold: float) -> float:
    """The same as printed, with (N - 1) for (N - 1 / x): its proof leaves out the 1 / x of Theorem 1's R^pi.

    Raises:
        ConfigError: an alpha is not above 1.
    """
    return _equation(problem, hold, 1.0)


def hold_by_equation(problem: HoldProblem, equation: Equation) -> int:
    """The N that one gets by solving `equation`: of the integers around its roots, and the two ends, the one
    of the least R^pi + R^env.

    Raises:
        ConfigError: an alpha is not above 1.
    """
    signs = [equation(problem, hold) > 0 for hold in range(problem.window + 1)]
    crossed = [hold for hold in range(problem.window) if signs[hold] != signs[hold + 1]]
    candidates = sorted({0, problem.window, *crossed, *(hold + 1 for hold in crossed)})
    return min(candidates, key=lambda hold: regret(problem, hold))


def _equation(problem: HoldProblem, hold: float, offset: float) -> float:
    _require_growth(problem)
    update, x = problem.window - hold, problem.rate
    policy = ((hold - offset) * math.log1p(-x) - 1.0) * (1.0 - x) ** update
    in_update = _slope(problem.alpha_1) * problem.b_1 * problem.alpha_1**update
    in_hold = _slope(problem.alpha_2) * problem.b_2 * problem.alpha_2**hold
    return float(problem.c_1 * policy + problem.c_45 * (in_update - in_hold))


def _slope(alpha: float) -> float:
    """The slope of geo(a, n) in n, over a^n: ln a / (a - 1)."""
    excess = alpha - 1.0
    return 1.0 if abs(excess) < ONE else math.log1p(excess) / excess


def _log_ratio(problem: HoldProblem) -> float:
    """W ln alpha_1 + ln(B_1 / B_2) + ln K."""
    _require_growth(problem)
    for name in ("b_1", "b_2"):
        if getattr(problem, name) == 0:
            raise ConfigError(name, 0.0, "must be above 0 for the closed form, which has its logarithm")
    slopes = math.log(_slope(problem.alpha_1)) - math.log(_slope(problem.alpha_2))
    lead = math.log(problem.b_1) - math.log(problem.b_2)
    return problem.window * math.log(problem.alpha_1) + lead + slopes


def _require_growth(problem: HoldProblem) -> None:
    for name in ("alpha_1", "alpha_2"):
        if getattr(problem, name) <= 1:
            raise ConfigError(name, getattr(problem, name), "must be above 1, as Assumption 1 has it")
