"""A promise with its verdict; and of a fleet's environments' verdicts one. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

WORDS = {False: "broke it", None: "not judged", True: "kept it"}  # the worst first


@dataclass(frozen=True)
class Clause:
    """One promise.

    Attributes:
        name: which.
        holds: whether it was kept; None: it cannot be judged.
        text: why, for people.
        numbers: what it was judged by.
    """

    name: str
    holds: bool | None
    text: str
    numbers: dict[str, Any] = field(default_factory=dict)


def passed(clauses: Sequence[Clause]) -> bool:
    """Whether none failed."""
    return all(clause.holds is not False for clause in clauses)


def together(each: Mapping[str, Clause], whole: Clause | None = None) -> Clause:
    """One clause of what was found of each environment, and of the whole run: as bad as the worst of them.

    Args:
        each: by the environment's name.
        whole: of the run; its text goes before that of an environment that is no worse.
    """
    order = list(WORDS)
    env, worst = min(each.items(), key=lambda item: order.index(item[1].holds))
    numbers: dict[str, Any] = {"envs": {name: one.numbers for name, one in each.items()}}
    if whole is not None:
        numbers = whole.numbers | numbers
        if order.index(whole.holds) <= order.index(worst.holds):
            return Clause(whole.name, whole.holds, whole.text, numbers)
    alike = sum(one.holds is worst.holds for one in each.values())
    text = f"{alike} of {len(each)} environments {WORDS[worst.holds]}; {env}: {worst.text}"
    return Clause(worst.name, worst.holds, text, numbers)
