"""How a window of W units is best split into G of update and N of hold, by the terms of the regret's bound.

With G = W - N, x = eta tau and geo(a, n) = (a^n - 1) / (a - 1), the paper's section 5 has two terms in N:

    R^pi(N)  = C_1 (1 - (1 - x)^G) / x + N C_1 (1 - x)^G                     (Theorem 1)
    R^env(N) = (C_4 + C_5) (B_1 geo(alpha_1, G) + B_2 geo(alpha_2, N))       (its f_2, Assumption 1)

The third, R^f = (N + G) (C_2 delta + C_3), is as printed the same for every N. Both terms have exact
differences,

    R^pi(N + 1) - R^pi(N)   = C_1 N x (1 - x)^(G - 1)
    R^env(N + 1) - R^env(N) = (C_4 + C_5) (B_2 alpha_2^N - B_1 alpha_1^(G - 1))

which never fall with N while both alphas are at least 1: the sum is discretely convex, and the least N with
a difference of at least 0 is the minimum. No calculus is needed, nor does the convexity in real N that the
paper claims hold everywhere. Its closed form and its equation are in `learner.theory.stationarity`.

This is the paper's problem, of Theorem 1 as printed. Of what `learner.theory.bounds` mends in it

- a is in C_5, which is a number here;
- b leaves R^env as it is: Assumption 1 is of any interval, so the same envelope bounds either anchor's sum;
- e, the exponent G - 1, divides C_1 by 1 - x in the differences. `best_settled_split` has it: the hold is
  the same or one unit shorter, because each of its differences is at most the next one here;
- c makes R^f depend on N, which no constant here tells. With the error at an anchor bounded by delta^f and
  the budget from there to t_{m+1}, R^f + R^env is least at N = 0 whatever changes: what a hold takes out of
  R^env, weighed by C_4 = 2 h, comes at least as often in R^f, weighed by C_2 h, and C_2 >= 4.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from rtcore.config import ConfigError

ONE = 1e-12  # a growth closer to 1 than this is 1: geo(a, n) = n to the last bit of a double
TIE = 1e-9  # of the terms' size: what differs by less is a tie; 1e6 times what rounding makes of W = 50
MOST = 1e20  # of any constant, and
LARGEST = 600.0  # of ln(alpha^W): products of these stay below the largest double, 1e308

_AT_LEAST_0 = ("c_1", "c_45", "b_1", "b_2")
_ABOVE_0 = ("eta", "tau", "alpha_1", "alpha_2")

Change = tuple[float, float]  # what one more unit of hold adds to an objective, and what it takes off


@dataclass(frozen=True, slots=True, kw_only=True)
class HoldProblem:
    """The scalars of section 5 that N and G follow from. Nothing has a unit but `window`.

    Attributes:
        window: W = t_{m+1} - t_m, in units of time.
        c_1: C_1, the distance of the policy from the optimal one as the window begins.
        c_45: C_4 + C_5, what a change of the world costs.
        eta, tau: step size and entropy weight of the policy's update; eta tau in (0, 1).
        alpha_1, alpha_2: growth of the variation budget per unit, in the update and in the hold.
        b_1, b_2: B^max of the update and of the hold.

    Raises:
        ConfigError: a value is out of its range, or alpha^W is beyond a double.
    """

    window: int
    c_1: float
    c_45: float
    eta: float
    tau: float
    alpha_1: float
    alpha_2: float
    b_1: float
    b_2: float

    def __post_init__(self) -> None:
        if not (self.window >= 1 and float(self.window).is_integer()):
            raise ConfigError("window", self.window, "must be a whole number, at least 1: W in units")
        for name in (*_AT_LEAST_0, *_ABOVE_0):
            value = getattr(self, name)
            if not (0 < value <= MOST or (value == 0 and name in _AT_LEAST_0)):
                words = "at least" if name in _AT_LEAST_0 else "above"
                raise ConfigError(name, value, f"must be a number {words} 0, at most {MOST:g}")
        if not self.rate < 1:
            raise ConfigError("eta", self.eta, f"eta tau must be below 1, and tau is {self.tau:g}")
        for name in ("alpha_1", "alpha_2"):
            if self.window * math.log(getattr(self, name)) > LARGEST:
                allowed = f"to the power of the window, {self.window}, must be below e^{LARGEST:g}"
                raise ConfigError(name, getattr(self, name), allowed)

    @property
    def rate(self) -> float:
        """The x of the formulas, eta tau: the share of the distance to the target that one update takes."""
        return self.eta * self.tau

    @property
    def convex(self) -> bool:
        """Whether both budgets grow, or at least do not shrink: then so is the objective."""
        return self.alpha_1 >= 1 - ONE and self.alpha_2 >= 1 - ONE


Objective = Callable[[HoldProblem, float], float]


@dataclass(frozen=True, slots=True)
class Split:
    """The split of a window that is best.

    Attributes:
        hold: N*, the smallest where several are equally good.
        update: G* = W - N*.
        value: the least value of the objective.
        ties: all N that are as good, `hold` first.
    """

    hold: int
    update: int
    value: float
    ties: tuple[int, ...]

    @property
    def update_share(self) -> float:
        """gamma_f* = G* / W."""
        return self.update / (self.update + self.hold)


def geometric_sum(ratio: float, count: float) -> float:
    """geo(a, n) = 1 + a + ... + a^(n - 1), continued to real n >= 0; n where a is 1. a > 0."""
    excess = ratio - 1.0
    if abs(excess) < ONE:
        return count
    return math.expm1(count * math.log1p(excess)) / excess  # no difference of nearly equal numbers


def policy_regret(problem: HoldProblem, hold: float) -> float:
    """R^pi(N) of Theorem 1, for a real N in [0, W]."""
    exponent = _update(problem, hold) * math.log1p(-problem.rate)
    return problem.c_1 * (-math.expm1(exponent) / problem.rate + hold * math.exp(exponent))


def environment_regret(problem: HoldProblem, hold: float) -> float:
    """R^env(N) under Assumption 1 (f_2), for a real N in [0, W]."""
    update = _update(problem, hold)
    in_update = problem.b_1 * geometric_sum(problem.alpha_1, update)
    return problem.c_45 * (in_update + problem.b_2 * geometric_sum(problem.alpha_2, hold))


def regret(problem: HoldProblem, hold: float) -> float:
    """R^pi(N) + R^env(N), for a real N in [0, W]. R^f, which no N changes, is left out."""
    return policy_regret(problem, hold) + environment_regret(problem, hold)


def best_split(problem: HoldProblem) -> Split:
    """The integer N in [0, W] of the least R^pi + R^env, exactly: by bisection, or where a budget shrinks
    (alpha < 1) and the sum need not be convex, by trying every N.
    """
    if not problem.convex:
        return _least_of(problem, regret, range(problem.window + 1))
    return _from(problem, regret, _bisect(problem, _total), _total)


def settled_regret(problem: HoldProblem, hold: float) -> float:
    """`regret` with the exponents that convergence has (e in `learner.theory.bounds`), N in [0, W - 1].

        C_1 (1 - (1 - x)^(G - 1)) / x + N C_1 (1 - x)^(G - 1) + R^env(N),    G >= 1

    without the C_0 of its R^pi, which is the same for every N.
    """
    if hold > problem.window - 1:
        raise ConfigError("hold", hold, f"must be in [0, {problem.window - 1}]: it needs an update")
    environment, exponent = environment_regret(problem, hold), (_update(problem, hold) - 1.0)
    left = math.exp(exponent * math.log1p(-problem.rate))
    return problem.c_1 * ((1.0 - left) / problem.rate + hold * left) + environment


def best_settled_split(problem: HoldProblem) -> Split:
    """The integer N in [0, W - 1] of the least `settled_regret`: that of `best_split`, or one less."""
    if not problem.convex:
        return _least_of(problem, settled_regret, range(problem.window))
    return _from(problem, settled_regret, _bisect(problem, _settled), _settled)


def best_policy_split(problem: HoldProblem) -> Split:
    """The integer N of the least R^pi alone: 0, and N = 1 is exactly as good (the lemma names 0 alone)."""
    return _from(problem, policy_regret, _bisect(problem, _policy), _policy)


def best_environment_split(problem: HoldProblem) -> Split:
    """The integer N in [0, W] of the least R^env alone.

    With alphas of at least 1, R^env rises from N on where B_2 alpha_2^N >= B_1 alpha_1^(W - N - 1), so

        N* = ceil([(W - 1) ln alpha_1 + ln(B_1 / B_2)] / (ln alpha_1 + ln alpha_2)), clipped to [0, W]

    With both below 1 it is concave, so one of the ends; with one above and one below, every N is tried.
    """
    if problem.convex:
        return _from(problem, environment_regret, _crossing(problem), _environment)
    concave = problem.alpha_1 < 1 and problem.alpha_2 < 1
    holds = (0, problem.window) if concave else range(problem.window + 1)
    return _least_of(problem, environment_regret, holds)


def _policy(problem: HoldProblem, hold: int) -> Change:
    x = problem.rate
    return float(problem.c_1 * hold * x * (1.0 - x) ** (problem.window - hold - 1)), 0.0


def _environment(problem: HoldProblem, hold: int) -> Change:
    up = problem.c_45 * problem.b_2 * problem.alpha_2**hold
    return float(up), float(problem.c_45 * problem.b_1 * problem.alpha_1 ** (problem.window - hold - 1))


def _total(problem: HoldProblem, hold: int) -> Change:
    (policy, _), (up, down) = _policy(problem, hold), _environment(problem, hold)
    return policy + up, down


def _settled(problem: HoldProblem, hold: int) -> Change:
    if hold >= problem.window - 1:
        return 1.0, 0.0  # no update would be left: no way on
    (policy, _), (up, down) = _policy(problem, hold), _environment(problem, hold)
    return policy / (1.0 - problem.rate) + up, down


def _direction(change: Change) -> int:
    """-1, 0 or 1: whether the objective falls, stays or rises with the next unit of hold."""
    up, down = change
    return 0 if abs(up - down) <= TIE * (up + down) else 1 if up > down else -1


def _bisect(problem: HoldProblem, change: Callable[[HoldProblem, int], Change]) -> int:
    """The least N from which the objective does not fall; W if it falls throughout."""
    return bisect_left(range(problem.window), 0, key=lambda hold: _direction(change(problem, hold)))


def _crossing(problem: HoldProblem) -> int:
    """The ceiling above, with its limits: budgets of 0, and no growth at all."""
    if problem.c_45 == 0 or problem.b_1 == 0:
        return 0
    if problem.b_2 == 0:
        return problem.window
    lead, growth_1 = math.log(problem.b_1) - math.log(problem.b_2), math.log(problem.alpha_1)
    growth = growth_1 + math.log(problem.alpha_2)
    if growth < ONE:
        return problem.window if lead > 2 * TIE else 0
    # up and down differ by less than TIE of their sum where their logarithms do by less than 2 TIE
    crossing = ((problem.window - 1) * growth_1 + lead - 2 * TIE) / growth
    return min(max(math.ceil(crossing), 0), problem.window)


def _from(
    problem: HoldProblem, objective: Objective, hold: int, change: Callable[[HoldProblem, int], Change]
) -> Split:
    """The split at the least N of a convex objective, with those behind it that are as good."""
    last = hold
    while last < problem.window and _direction(change(problem, last)) == 0:
        last += 1
    return Split(hold, problem.window - hold, objective(problem, hold), tuple(range(hold, last + 1)))


def _least_of(problem: HoldProblem, objective: Objective, holds: Iterable[int]) -> Split:
    values = {hold: objective(problem, hold) for hold in holds}
    least = min(values.values())
    ties = tuple(hold for hold, value in values.items() if value - least <= TIE * abs(least))
    return Split(ties[0], problem.window - ties[0], values[ties[0]], ties)


def _update(problem: HoldProblem, hold: float) -> float:
    if not 0 <= hold <= problem.window:
        raise ConfigError("hold", hold, f"must be in [0, {problem.window}], the window")
    return problem.window - hold
