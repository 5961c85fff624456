"""`tenuto doctor`: what this machine has and lacks for real time, and how to grant it.

Exit code 0 if a run with `agent.rt = "require"` would start here, else 1, so that scripts can ask.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from launcher import drawing
from launcher.cli import DONE, FAILED, CommandError
from launcher.doctor.facts import gather
from launcher.doctor.findings import Finding, State, findings, verdict
from launcher.drawing import ACCENT, LABEL
from launcher.echo.measure import EchoError, EchoResult, measure_echo
from launcher.latency.results import SETTLED_S
from launcher.machine import machine
from launcher.parsing import parse
from launcher.run import RUNS
from rtcore.config import ConfigError
from rtcore.realtime import Rt

HZ = 1000.0
MARKS: dict[State, tuple[str, str]] = {
    "good": ("ok", "green"),
    "lacking": ("lacking", "red"),
    "better": ("could be better", "yellow"),
}
WAYS: dict[Rt, str] = {"off": "without any of it", "auto": "with what is granted"}

Measured = Mapping[Rt, EchoResult]


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """Say what this machine has and lacks for real time, what more would gain, and how to grant it."""

    seconds: float = 3.0
    """How long each of the two measurements lasts; 0: none."""
    runs: Path = RUNS
    """Where runs will go: its disk is looked at."""


def doctor(argv: Sequence[str]) -> int:
    """`tenuto doctor`."""
    description = f"{DoctorOptions.__doc__} Exit code 0 if agent.rt = 'require' would start here, else 1."
    options = parse(DoctorOptions, argv, prog="tenuto doctor", description=description)
    if options.seconds and not SETTLED_S < options.seconds < float("inf"):
        allowed = f"must be 0, or above {SETTLED_S:g}: the first second is a warm-up"
        raise ConfigError("seconds", options.seconds, allowed)
    console = Console()
    facts = gather(options.runs)
    measured = _measure(options.seconds, console)
    found = findings(facts, stolen(measured, os.cpu_count() or 1))
    console.print(render(found, measured, str(machine()["processor"])), highlight=False, crop=False)
    style = "red" if facts.probed.missing else "green"
    console.print(Text(verdict(facts), style=style), soft_wrap=True)
    return FAILED if facts.probed.missing else DONE


def stolen(measured: Measured, processors: int) -> float | None:
    """The share of all processor time that the host took during the measurements; None if untold."""
    spans = [(one.steal_s, one.span_s * processors) for one in measured.values()]
    known = [(steal_s, whole_s) for steal_s, whole_s in spans if steal_s is not None]
    return sum(steal_s for steal_s, _ in known) / sum(whole_s for _, whole_s in known) if known else None


def render(found: Sequence[Finding], measured: Measured, processor: str) -> RenderableType:
    """The diagnosis and, if there was one, the measurement."""
    parts: list[RenderableType] = [Text(f"Real time on this machine: {processor}\n", style=f"bold {ACCENT}")]
    parts += [_lines(finding) for finding in found]
    if measured:
        parts += [Text(), _comparison(measured), Text()]
    return Group(*parts)


def _lines(finding: Finding) -> RenderableType:
    """A finding and, below it, what to do. The commands are never wrapped: people copy them."""
    word, colour = MARKS[finding.state]
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(width=14, style=LABEL)
    table.add_column(width=15)
    table.add_column()
    table.add_row(finding.topic, Text(word, style=colour), finding.found)
    if finding.gain:
        table.add_row("", Text("would gain", style=LABEL), finding.gain)
    commands = [Text(f"    {line}", style="bold", no_wrap=True, overflow="ignore") for line in finding.grant]
    return Group(table, *commands)


def _comparison(measured: Measured) -> Table:
    """Pacing and round trip, without and with what is granted, after the first second."""
    title = f"Measured here: a bare echo over Zenoh at {HZ:g} Hz beside a busy process, µs"
    table = Table(title=title, title_justify="left", title_style=LABEL, box=None, padding=(0, 2, 0, 0))
    table.add_column("", style=LABEL)
    table.add_column("", style=LABEL)
    for head in ("p50", "p99", "p99.9", "max"):
        table.add_column(head, justify="right", header_style=LABEL)
    table.add_column("missed", header_style=LABEL)
    for name in ("pacing error", "round trip"):
        for index, (rt, echo) in enumerate(measured.items()):
            values = echo.pacing_us(SETTLED_S) if name == "pacing error" else echo.latency_us(SETTLED_S)
            missed = drawing.misses(echo.missed, echo.miss_ratio) if name == "round trip" else ""
            table.add_row(
                name if index == 0 else "", WAYS[rt], *map(drawing.microseconds, values.values()), missed
            )
    return table


def _measure(seconds: float, console: Console) -> dict[Rt, EchoResult]:
    if not seconds:
        return {}
    console.print(f"measuring for {2 * seconds:g} s\n", highlight=False)
    try:
        return {rt: measure_echo("zenoh", hz=HZ, seconds=seconds, rt=rt, load=True) for rt in WAYS}
    except EchoError as error:
        raise CommandError(str(error)) from error
