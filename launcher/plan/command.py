"""`tenuto plan`: the best split of a window by the paper's bound, from constants or from a run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from tyro.conf import Positional

from launcher.cli import DONE
from launcher.out_dir import make_out_dir
from launcher.parsing import parse
from launcher.plan.constants import NAMES, Number, Plan, check_window, read_constants, settle
from launcher.plan.results import CAVEAT, as_json, render
from launcher.run import RUNS
from rtcore.config import ConfigError
from rtcore.files import write_atomic
from rtcore.run_dir import default_run_path

DATA, PICTURE = "plan.json", "plan.png"


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """Find how long to update (G) and to hold (N) in a window of W units, by the paper's bound on regret."""

    run: Positional[Path | None] = None
    """RUN, a run's directory with a recording: what is not given is estimated or assumed from it."""
    config: Path | None = None
    """A TOML file of constants, one `name = number` a line; flags go before it."""
    out: Path | None = None
    """Directory for plan.json and plan.png; it must not exist yet. None: print only."""
    figures: bool = False
    """Draw the paper's four panels and its example instead, by default in runs/<utc>-plan."""
    window: int | None = None
    """W, units from one window's begin to the next's."""
    c_1: float | None = None
    """C_1, the policy's distance from the best one as the window begins. Alone: 1."""
    c_45: float | None = None
    """C_4 + C_5, what a change of the world costs."""
    eta: float | None = None
    """Step size of the policy."""
    tau: float | None = None
    """Weight of the entropy; eta tau must be below 1."""
    alpha_1: float | None = None
    """Growth of the variation budget per unit of the update."""
    alpha_2: float | None = None
    """The same in the hold. Alone: as alpha_1."""
    b_1: float | None = None
    """B^max, scale of the variation budget in the update. Alone: 1."""
    b_2: float | None = None
    """The same in the hold. Alone: as b_1."""


def plan(argv: Sequence[str]) -> int:
    """`tenuto plan`."""
    options = parse(PlanOptions, argv, prog="tenuto plan", description=str(PlanOptions.__doc__))
    console = Console()
    flags = {name: value for name in NAMES if (value := getattr(options, name)) is not None}
    if options.figures:
        return _figures(options, flags, console)
    planned = _planned(options, flags)
    out = options.out
    if out is not None:
        make_out_dir(out)
    console.print(render(planned), highlight=False)
    if out is not None:
        from launcher.plan.picture import draw_plan  # most of a second, that a printed plan need not wait for

        _write(out, as_json(planned), console)
        draw_plan(planned, out / PICTURE)
        console.print(f"picture  {out / PICTURE}", highlight=False, soft_wrap=True)
    return DONE


def _planned(options: PlanOptions, flags: dict[str, Number]) -> Plan:
    file = None if options.config is None else read_constants(options.config)
    if options.run is None:
        return settle(flags, file)
    from launcher.plan.estimate import from_run  # loads the recording's library

    length = flags.get("window", (file or {}).get("window"))
    return settle(flags, file, from_run(options.run, None if length is None else check_window(length)))


def _figures(options: PlanOptions, flags: dict[str, Number], console: Console) -> int:
    """Write the panels' constants, minima and picture."""
    given = [name for name in ("run", "config") if getattr(options, name) is not None] + list(flags)
    if given:
        raise ConfigError(given[0], str(getattr(options, given[0])), "not together with --figures")
    from launcher.plan.panels import panels, panels_json
    from launcher.plan.picture import draw_panels

    drawn = panels()
    out = options.out or default_run_path(RUNS, "plan", datetime.now(UTC))
    make_out_dir(out)
    for panel in drawn:
        minima = ", ".join(f"{curve.label} at {curve.best.hold}" for curve in panel.curves)
        console.print(f"{panel.name:>10}  least N: {minima}", highlight=False)
    console.print(f"\n{CAVEAT}\n", highlight=False)
    _write(out, panels_json(drawn) | {"remarks": [CAVEAT]}, console)
    draw_panels(drawn, out / PICTURE)
    console.print(f"picture  {out / PICTURE}", highlight=False, soft_wrap=True)
    return DONE


def _write(out: Path, data: dict[str, Any], console: Console) -> None:
    write_atomic(out / DATA, (json.dumps(data, indent=2) + "\n").encode())
    console.print(f"results  {out / DATA}", highlight=False, soft_wrap=True)
