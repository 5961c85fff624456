"""chaos.json, and one screen of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from launcher.chaos.clause import Clause, passed
from launcher.chaos.faults import Done
from launcher.chaos.plan import KINDS, LINK
from launcher.drawing import LABEL, pairs
from launcher.report import WIDTH
from rtcore.cast import role_of
from rtcore.channels import PROCESSES

SCHEMA = 1
VERDICTS = {True: ("kept", "green"), False: ("BROKEN", "bold red"), None: ("not judged", "yellow")}


def as_json(
    run: str, options: dict[str, Any], done: Sequence[Done], clauses: Sequence[Clause]
) -> dict[str, Any]:
    """What chaos.json holds."""
    return {
        "schema": SCHEMA,
        "run": run,
        **options,
        "passed": passed(clauses),
        "clauses": [asdict(clause) for clause in clauses],
        "faults": [asdict(one.fault) | {"done_at_s": one.at_s} for one in done],
    }


def render(run: str, done: Sequence[Done], clauses: Sequence[Clause], path: Path) -> RenderableType:
    """One screen."""
    body = Group(_faults(done), Text(), _clauses(clauses), Text(), pairs([("details", str(path))]))
    verdict = "every promise kept" if passed(clauses) else "promises broken"
    return Panel(
        body,
        title=f"[bold]chaos in {run}[/]",
        subtitle=verdict,
        title_align="left",
        subtitle_align="right",
        border_style=LABEL if passed(clauses) else "red",
        padding=(0, 1),
        width=WIDTH,
    )


def _faults(done: Sequence[Done]) -> Table:
    counted = Counter((role_of(one.fault.process), one.fault.kind) for one in done if one.at_s is not None)
    kinds = [kind for kind in KINDS if any(one.fault.kind == kind for one in done)]
    table = Table.grid(padding=(0, 3))
    table.add_column(style=LABEL)
    table.add_row("faults", *(Text(kind, style=LABEL) for kind in kinds))
    for process in (*PROCESSES, *([LINK] if "partition" in kinds else [])):
        table.add_row(process, *(str(counted[process, kind]) for kind in kinds))
    return table


def _clauses(clauses: Sequence[Clause]) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(style=LABEL, no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column()
    for clause in clauses:
        word, style = VERDICTS[clause.holds]
        table.add_row(clause.name, Text(word, style=style), clause.text)
    return table
