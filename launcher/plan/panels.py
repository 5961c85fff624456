"""The paper's numerical panels (section 5.3) and its example of a budget, as numbers.

The paper does not state W, alpha_2, B_2, C_1 or C_4 + C_5; these are constants with which its text holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from learner.theory.budgets import cumulative
from learner.theory.optimum import (
    HoldProblem,
    Objective,
    Split,
    best_environment_split,
    best_split,
    environment_regret,
    regret,
)

# alpha_2 must be above 1 / 0.98, or alpha_1 = 0.98 alpha_2 would not be above 1.
GROWTH = HoldProblem(
    window=50, c_1=1.0, c_45=1.0, eta=1.0, tau=0.1, alpha_1=1.05, alpha_2=1.05, b_1=1.0, b_2=1.0
)
# B moves the minimum by ln(B_1 / B_2) / (2 ln alpha): with alpha = 1.05 by less than 0.6 in all of the panel.
SCALE = replace(GROWTH, alpha_1=1.01, alpha_2=1.01)
DOMINANCE = replace(SCALE, window=20)
RATE = replace(GROWTH, c_45=0.02)
# The rate's panel again where the text does not hold: W is not long against 1 / x.
SHORT = replace(RATE, window=20, c_45=0.1)

GROWTH_RATIOS = (0.98, 0.99, 1.0, 1.01, 1.02)
SCALE_RATIOS = (0.94, 0.97, 1.0, 1.03, 1.06)
DOMINANCES = {0.0: 0.0, 0.86: 3.278, 0.92: 6.164, 0.95: 10.206}  # C^R as printed -> C_4 + C_5
RATES = (0.01, 0.1, 0.3, 0.7, 0.99)

# |R_{t+1} - R_t| at (s_0, a_0). The one path of a window of 6 with the budgets of the paper's example: 1 at
# G = 2 and G = 4, the least, and 3 at G = 6. What follows the last unit is in no budget.
EXAMPLE_CHANGES = (0.0, 0.5, 0.0, 0.5, 0.0)
EXAMPLE_WINDOW = 6


@dataclass(frozen=True)
class Curve:
    """One setting of a panel: an objective over N = 0 .. W, and its minimum."""

    label: str
    problem: HoldProblem
    values: tuple[float, ...]
    best: Split


@dataclass(frozen=True)
class Panel:
    """One of the four, and how it is drawn: `relative`, as shares of each curve's own largest value."""

    name: str
    title: str
    setting: str
    curves: tuple[Curve, ...]
    relative: bool = False
    logarithmic: bool = False


def panels() -> tuple[Panel, ...]:
    """The four panels, in the paper's order."""
    return (
        Panel(
            "growth", r"$R^{env}$ by $\alpha_1 / \alpha_2$", r"W = 50, $\alpha_2$ = 1.05, $B_1 = B_2$ = 1",
            tuple(_environment(f"{r:g}", replace(GROWTH, alpha_1=r * GROWTH.alpha_2)) for r in GROWTH_RATIOS),
        ),
        Panel(
            "scale", r"$R^{env}$ by $B_1 / B_2$", r"W = 50, $\alpha_1 = \alpha_2$ = 1.01, $B_2$ = 1",
            tuple(_environment(f"{r:g}", replace(SCALE, b_1=r)) for r in SCALE_RATIOS),
        ),
        Panel(
            "dominance", r"$R^{env} + R^{\pi}$ by the dominance $C^R$",
            r"W = 20, $\alpha_1 = \alpha_2$ = 1.01, $B_1 = B_2$ = 1, $\eta\tau$ = 0.1, $C_1$ = 1",
            tuple(_both(f"{r:g}", replace(DOMINANCE, c_45=c_45)) for r, c_45 in DOMINANCES.items()),
            relative=True,
        ),
        Panel(
            "rate", r"$R^{env} + R^{\pi}$ by the learning rate $\eta\tau$",
            r"W = 50, $\alpha_1 = \alpha_2$ = 1.05, $B_1 = B_2$ = 1, $(C_4 + C_5) / C_1$ = 0.02",
            tuple(_both(f"{rate:g}", replace(RATE, eta=rate, tau=1.0)) for rate in RATES),
            relative=True,
            logarithmic=True,
        ),
    )  # fmt: skip


def short_window_holds() -> tuple[int, ...]:
    """N* over `RATES` for a window of 20 and (C_4 + C_5) / C_1 = 0.1, where it does not rise throughout."""
    return tuple(best_split(replace(SHORT, eta=rate, tau=1.0)).hold for rate in RATES)


def dominance(problem: HoldProblem) -> float:
    """C^R: the mean over N = 0 .. W of R^env / (R^env + R^pi). The printed integral has no 1 / W before it
    and so would be of the order of W, not below 1.
    """
    holds = range(problem.window + 1)
    return sum(environment_regret(problem, hold) / regret(problem, hold) for hold in holds) / len(holds)


def panels_json(drawn: Sequence[Panel]) -> dict[str, Any]:
    """plan.json of the figures: constants, curves and minima, and what does not fit into the panels."""
    return {
        "schema": 1,
        "panels": {
            panel.name: [
                {
                    "label": curve.label,
                    "constants": asdict(curve.problem),
                    "N": curve.best.hold,
                    "as_good": list(curve.best.ties),
                    "values": list(curve.values),
                }
                for curve in panel.curves
            ]
            for panel in drawn
        },
        "dominance": {label: dominance(replace(DOMINANCE, c_45=c_45)) for label, c_45 in DOMINANCES.items()},
        "short_window": {"rates": list(RATES), "N": list(short_window_holds())},
        "example": {"changes": list(EXAMPLE_CHANGES), "sum_by_G": list(example())},
    }


def example() -> tuple[float, ...]:
    """Bbar(0, G) + Bbar(G, W) of the paper's example for G = 0 .. W, with C_4 = C_5 = 1."""
    changes = np.array(EXAMPLE_CHANGES)
    return tuple(
        cumulative(changes, 0, update) + cumulative(changes, update, EXAMPLE_WINDOW)
        for update in range(EXAMPLE_WINDOW + 1)
    )


def _environment(label: str, problem: HoldProblem) -> Curve:
    return _curve(label, problem, environment_regret, best_environment_split(problem))


def _both(label: str, problem: HoldProblem) -> Curve:
    return _curve(label, problem, regret, best_split(problem))


def _curve(label: str, problem: HoldProblem, objective: Objective, best: Split) -> Curve:
    return Curve(label, problem, tuple(objective(problem, hold) for hold in range(problem.window + 1)), best)
