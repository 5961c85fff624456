"""What a plan comes to, for people and as plan.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from launcher import drawing
from launcher.drawing import ACCENT, LABEL
from launcher.plan.constants import NAMES, Plan
from learner.theory.optimum import (
    HoldProblem,
    Split,
    best_environment_split,
    best_policy_split,
    best_settled_split,
    best_split,
    environment_regret,
    policy_regret,
)
from learner.theory.stationarity import (
    closed_form_hold,
    closed_form_hold_printed,
    hold_by_equation,
    stationarity,
    stationarity_printed,
)

SCHEMA = 1
ROWS = 30  # of the table; plan.json has all
SYMBOLS = {
    "window": "W", "c_1": "C_1", "c_45": "C_4 + C_5", "eta": "eta", "tau": "tau", "alpha_1": "alpha_1",
    "alpha_2": "alpha_2", "b_1": "B_1", "b_2": "B_2",
}  # fmt: skip
CAVEAT = (
    "N* is where this bound is least, which need not be where the regret is: a bound that is rigorous for a "
    "single window, from a given policy, is always least at N = 0."
)


def as_json(plan: Plan) -> dict[str, Any]:
    """plan.json: constants with their origins, the best splits, the terms for every N, and the calculus."""
    problem = plan.problem
    return {
        "schema": SCHEMA,
        "constants": {name: {"value": getattr(problem, name), "from": plan.origins[name]} for name in NAMES},
        "unit_s": plan.unit_s,
        "best": _split_json(best_split(problem)),
        "settled": _split_json(best_settled_split(problem)),
        "policy_term_alone": _split_json(best_policy_split(problem)),
        "environment_term_alone": _split_json(best_environment_split(problem)),
        "calculus": calculus(problem),
        "terms": [
            dict(zip(("N", "G", "policy", "environment", "sum"), row, strict=True)) for row in terms(problem)
        ],
        "remarks": [*plan.remarks, CAVEAT],
    }


def terms(problem: HoldProblem) -> list[tuple[int, int, float, float, float]]:
    """(N, G, R^pi, R^env, their sum) for every N in [0, W]."""
    rows = []
    for hold in range(problem.window + 1):
        policy, environment = policy_regret(problem, hold), environment_regret(problem, hold)
        rows.append((hold, problem.window - hold, policy, environment, policy + environment))
    return rows


def calculus(problem: HoldProblem) -> dict[str, float | int | None] | None:
    """The paper's closed form and equation, corrected and as printed; None where they do not apply, because
    a B is 0 or an alpha is not above 1. The printed closed form is None where the alphas are equal.
    """
    if min(problem.alpha_1, problem.alpha_2) <= 1 or min(problem.b_1, problem.b_2) <= 0:
        return None
    printed = closed_form_hold_printed(problem)
    return {
        "environment_hold": closed_form_hold(problem),
        "environment_hold_printed": None if math.isnan(printed) else printed,
        "hold": hold_by_equation(problem, stationarity),
        "hold_printed": hold_by_equation(problem, stationarity_printed),
    }


def render(plan: Plan) -> RenderableType:
    """The constants, the answer, the terms, and what to think of it."""
    parts: list[RenderableType] = [
        _constants(plan),
        Text(),
        _answer(plan),
        Text(),
        _terms(plan.problem),
        Text(),
    ]
    parts += [Text(remark, style=LABEL) for remark in (*plan.remarks, CAVEAT)]
    return Group(*parts)


def _constants(plan: Plan) -> Table:
    table = Table.grid(padding=(0, 2))
    for name in NAMES:
        value = getattr(plan.problem, name)
        table.add_row(Text(SYMBOLS[name], style=LABEL), f"{value:.6g}", Text(plan.origins[name], style=LABEL))
    return table


def _answer(plan: Plan) -> Table:
    problem, best = plan.problem, best_split(plan.problem)
    rows: list[tuple[str, Text | str]] = [
        (
            "best",
            Text(
                f"N* = {best.hold}, G* = {best.update}, gamma_f* = {best.update_share:.4g}",
                style=f"bold {ACCENT}",
            ),
        ),
        *_use(plan, best),
        ("repaired", f"{_told(best_settled_split(problem))}, with (1 - x)^(G - 1) in R^pi"),
        ("R^pi alone", _told(best_policy_split(problem))),
        ("R^env alone", _told(best_environment_split(problem))),
    ]
    found = calculus(problem)
    if found is None:
        rows.append(("by calculus", "not with a B of 0"))
    else:
        printed = found["environment_hold_printed"]
        rows.append((
            "closed form", f"R^env is least at {found['environment_hold']:.2f}; as printed "
            + ("it divides by 0" if printed is None else f"{printed:.2f}"),
        ))  # fmt: skip
        rows.append(("equation", f"N = {found['hold']}; as printed {found['hold_printed']}"))
    return drawing.pairs(rows)


def _use(plan: Plan, best: Split) -> list[tuple[str, Text | str]]:
    """How to run with it, and what it is in seconds."""
    if best.update == 0:
        return [("", "never to update; a schedule updates for one unit at least")]
    length = plan.problem.window
    flags = f"--learner.schedule.l-f {length} --learner.schedule.gamma-f {best.update_share!r}"
    if plan.unit_s is None:
        return [("", flags)]
    return [("", f"{best.update * plan.unit_s:g} s of update in {length * plan.unit_s:g} s"), ("", flags)]


def _told(split: Split) -> str:
    others = ", ".join(map(str, split.ties[1:4])) + (", ..." if len(split.ties) > 4 else "")
    return f"N = {split.hold}" + (f", and as good {others}" if others else "")


def _terms(problem: HoldProblem) -> Table:
    best = best_split(problem)
    table = Table(box=None, padding=(0, 2, 0, 0), header_style=LABEL)
    for head in ("N", "G", "R^pi", "R^env", "sum", "over the least"):
        table.add_column(head, justify="right", no_wrap=True)
    stride = math.ceil((problem.window + 1) / ROWS)
    for hold, update, policy, environment, both in terms(problem):
        if hold % stride and hold not in (best.hold, problem.window):
            continue
        above = f"{100 * (both / best.value - 1):.2f} %" if best.value else "·"
        style = f"bold {ACCENT}" if hold in best.ties else ""
        numbers = (f"{policy:.5g}", f"{environment:.5g}", f"{both:.5g}")
        table.add_row(str(hold), str(update), *numbers, above, style=style)
    return table


def _split_json(split: Split) -> Mapping[str, Any]:
    return {
        "N": split.hold, "G": split.update, "gamma_f": split.update_share, "value": split.value,
        "as_good": list(split.ties),
    }  # fmt: skip
