"""One screen on what a run did, from its summary.json; `tenuto report RUN` shows it again."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from rich.console import Console, Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional

from launcher import drawing
from launcher.cli import DONE
from launcher.drawing import ACCENT, LABEL
from launcher.parsing import parse
from launcher.summary import SCHEMA, Summary, discrepancies
from rtcore.config import ConfigError
from rtcore.run_dir import RunDir

WIDTH = 100
EDGE = 10  # episodes that the first and the last mean are taken over


@dataclass(frozen=True)
class ReportOptions:
    """Show a run's report again."""

    run: Positional[Path]
    """The run directory."""


def report(argv: Sequence[str]) -> int:
    """`tenuto report RUN`."""
    options = parse(ReportOptions, argv, prog="tenuto report", description="Show a run's report again.")
    run_dir = RunDir(options.run)
    summary = load(run_dir)
    try:
        rendered = render(summary, run_dir)
    except (KeyError, TypeError) as error:
        raise ConfigError("run", str(run_dir.path), f"its summary.json lacks {error}") from error
    Console().print(rendered)
    return DONE


def load(run_dir: RunDir) -> Summary:
    """Read a run's summary.

    Raises:
        ConfigError: there is none, or not one of ours.
    """
    try:
        summary = json.loads(run_dir.summary_path.read_text())
    except OSError as error:
        raise ConfigError("run", str(run_dir.path), f"needs a summary.json ({error.strerror})") from error
    except ValueError as error:
        raise ConfigError("run", str(run_dir.path), "its summary.json is no JSON") from error
    if not isinstance(summary, dict) or summary.get("schema") != SCHEMA:
        raise ConfigError("run", str(run_dir.path), f"needs a summary.json of schema {SCHEMA}")
    return summary


def render(summary: Summary, run_dir: RunDir) -> RenderableType:
    """The report."""
    body = Group(
        _real_time(summary),
        Text(),
        *([_envs(summary["envs"]), Text()] if "envs" in summary else []),
        _learning(summary),
        Text(),
        _accounts(summary),
        Text(),
        _files(run_dir, "sim" if summary.get("clock") == "virtual" else "run"),
    )
    about = f"{summary['env']}  {summary['algo']}  seed {summary['seed']}"
    return Panel(
        body,
        title=f"[bold]{summary['run']}[/]",
        subtitle=about,
        title_align="left",
        subtitle_align="right",
        border_style=LABEL,
        padding=(0, 1),
        width=WIDTH,
    )


def _real_time(summary: Summary) -> RenderableType:
    deadlines = summary["deadlines"]
    causes = drawing.causes(deadlines["missed_by_cause"])
    rows: list[tuple[str, Text | str]] = [
        ("ticks", f"{summary['ticks']:,} at {_each(summary)}{drawing.number(summary['tick_hz'], 1)} Hz"),
        ("missed", drawing.misses(deadlines["missed"], deadlines["miss_ratio"])),
        *([("", causes)] if causes else []),
        ("overruns", f"{deadlines['overruns']:,}"),
    ]
    times = drawing.latencies(
        {
            "pacing error": summary["pacing_error_us"],
            "reaction": summary["reaction_us"],
            "loop": summary["loop_us"],
        }
    )
    return _side_by_side(drawing.pairs(rows), times)


def _each(summary: Summary) -> str:
    """Of a fleet, how many times what follows."""
    count = summary.get("env_count", 1)
    return "" if count == 1 else f"{count} x "


def _envs(rows: Summary) -> RenderableType:
    """What each environment of a fleet did."""
    table = Table.grid(padding=(0, 1))
    table.add_column(style=LABEL, no_wrap=True)
    heads = ("ticks", "missed", "episodes", "return", "learned", "lost", "adopted", "↻")
    for _ in heads:
        table.add_column(justify="right", no_wrap=True)
    table.add_row("", *(Text(head, style=LABEL) for head in heads))
    for name, row in rows.items():
        table.add_row(
            name,
            f"{row['ticks']:,}",
            drawing.misses(row["missed"], row["miss_ratio"]),
            f"{row['episodes']:,}",
            drawing.number(row["mean_return"], 2),
            f"{row['learned']:,}",
            f"{row['lost']:,}",
            f"{row['adopted']:,}",
            str(sum(row["restarts"].values())),
        )
    return table


def _learning(summary: Summary) -> RenderableType:
    returns, policies, learner = summary["returns"], summary["policies"], summary["learner"]
    first, last = returns[:EDGE], returns[-EDGE:]
    rows: list[tuple[str, Text | str]] = [
        ("episodes", f"{summary['episodes']:,}, mean return {drawing.number(summary['mean_return'], 2)}"),
    ]
    one_after_the_other = "envs" not in summary  # a fleet's are environment by environment: no course of time
    if one_after_the_other:
        rows.append(("return", Text(drawing.sparkline(returns, WIDTH - 30), style=ACCENT)))
    if one_after_the_other and len(returns) >= 2 * EDGE:
        rows.append(("", f"first {EDGE}: {fmean(first):,.2f}   last {EDGE}: {fmean(last):,.2f}"))
    windows = summary["windows"]
    shape = ", ".join(sorted({f"G {one['G']} N {one['N']}" for one in windows[:-1] or windows}))
    adopt = policies["publish_to_adopt_ms"]
    rows += [
        ("windows", f"{len(windows)}" + (f" ({shape})" if windows else "")),
        (
            "updates",
            f"{learner['gradient_steps']:,} of Q, {learner['policy_steps']:,} of the policy; "
            f"{drawing.number(learner['updates_per_s'], 1)} /s",
        ),
        (
            "policies",
            f"{policies['published']} published, {policies['adopted']} adopted{_again(policies)}, "
            f"{policies['published_in_hold']} in a hold; adopted after "
            f"{drawing.number(adopt['p50'], 1)} ms (p99 {drawing.number(adopt['p99'], 1)})",
        ),
    ]
    forecast = summary["forecast"]
    if forecast["windows"] is not None:
        error, baseline = (
            drawing.number(forecast["error"], 3),
            drawing.number(forecast["baseline_error"], 3),
        )
        rows.append(("forecast", f"{forecast['windows']} judged, error {error} against {baseline} without"))
    if summary.get("regret") is not None:
        rows.append(("regret", _regret(summary["regret"])))
    return drawing.pairs(rows)


def _again(policies: Summary) -> str:
    """What adds to the adopted, after restarts of the agent."""
    return f" ({policies['received_again']} received again)" if policies["received_again"] else ""


def _regret(regret: Summary) -> str:
    """Exact, a unit's mean in all and in each phase."""
    phases = [
        f"{phase} {drawing.number(regret[phase] / units, 3)}"
        for phase in ("update", "hold")
        if (units := regret[f"{phase}_units"])
    ]
    return f"{drawing.number(regret['per_unit'], 3)} per unit ({', '.join(phases)})"


def _accounts(summary: Summary) -> RenderableType:
    transitions, recorder = summary["transitions"], summary["recorder"]
    restarts = ", ".join(f"{process} {n}" for process, n in summary["restarts"].items() if n)
    rows: list[tuple[str, Text | str]] = [
        (
            "transitions",
            f"{transitions['produced']:,} produced, {transitions['learned']:,} learned, "
            f"{transitions['lost']:,} lost, {transitions['duplicate']:,} duplicate",
        ),
        (
            "recorded",
            f"{recorder['rows']:,} rows, {recorder['dropped']:,} dropped; "
            f"{summary['messages']['rejected']:,} messages rejected",
        ),
    ]
    if lacking := {name: count for name, count in summary.get("disk", {}).items() if count}:
        text = ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in lacking.items())
        rows.append(("not on disk", Text(text, style="red")))
    found = discrepancies(summary)
    if foreign := summary["policies"].get("foreign", 0):
        rows.append(("refused", Text(f"{foreign:,} policies that are not the learner's", style="red")))
    rows.append(("counts", Text("; ".join(found), style="red") if found else "reconcile"))
    if restarts:
        rows.append(("restarts", restarts))
    if summary["forced"]:
        rows.append(("killed", Text(", ".join(summary["forced"]) + " did not end in time", style="red")))
    rows.append(("ended", f"after {drawing.clock(summary['wall_s'])}: {summary['ended']}"))
    return drawing.pairs(rows)


def _files(run_dir: RunDir, command: str) -> RenderableType:
    rows: list[tuple[str, Text | str]] = []
    if run_dir.recording_path.exists():
        rows.append(("recording", str(run_dir.recording_path)))
        rows.append(("open it", Text(f"tenuto view {run_dir.path}", style="bold")))
    rows.append(("run again", Text(f"tenuto {command} --config {run_dir.config_path}", style="bold")))
    return drawing.pairs(rows)


def _side_by_side(left: RenderableType, right: RenderableType) -> Table:
    table = Table.grid(padding=(0, 4))
    table.add_column()
    table.add_column()
    table.add_row(left, right)
    return table
