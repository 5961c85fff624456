"""The tables of `tenuto latency`: one for each rate and load, and an overview."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from launcher import drawing
from launcher.drawing import ACCENT, LABEL
from launcher.echo.links import Transport
from launcher.latency.results import SETTLED_S, Cell
from launcher.latency.trial import Load
from launcher.quantiles import SHARES, Quantiles

LOADS: dict[Load, str] = {"learner": "learner saturating", "none": "no load"}
ECHOES: dict[Transport, str] = {"zenoh": "bare Zenoh echo", "unix": "bare unix socket"}
HEADS = {"p50": "p50", "p99": "p99", "p999": "p99.9", "max": "max"}


def cell_table(cell: Cell) -> Table:
    """One rate under one load: durations in microseconds, the misses, and what the host took."""
    table = Table(
        title=f"{cell.hz:g} Hz, {LOADS[cell.load]}",
        title_justify="left",
        title_style=f"bold {ACCENT}",
        box=None,
        padding=(0, 2, 0, 0),
    )
    table.add_column("µs", style=LABEL, no_wrap=True, header_style=LABEL)
    for name in SHARES:
        table.add_column(HEADS[name], justify="right", no_wrap=True, header_style=LABEL)
    table.add_column("missed", no_wrap=True, header_style=LABEL)
    table.add_column("steal", justify="right", no_wrap=True, header_style=LABEL)
    system = cell.system
    table.add_row("pacing error", *_durations(system.quantiles_us("pacing")))
    table.add_row("reaction", *_durations(system.quantiles_us("reaction")))
    missed = drawing.misses(system.missed, system.miss_ratio)
    table.add_row("loop", *_durations(system.quantiles_us("loop")), missed, _seconds(system.steal_s))
    for transport, label in ECHOES.items():
        if transport in cell.echoes:
            echo = cell.echoes[transport]
            missed = drawing.misses(echo.missed, echo.miss_ratio)
            table.add_row(label, *_durations(echo.latency_us()), missed, _seconds(echo.steal_s))
    if "zenoh" in cell.echoes:
        table.add_row("loop / Zenoh echo", *(_times(value) for value in cell.ratio("zenoh").values()))
    return table


def remarks(cell: Cell) -> list[str]:
    """What a table has no column for: causes, lost deadlines, misses of the first second, refused rights."""
    system, found = cell.system, []
    if system.missed:
        causes = ", ".join(f"{count} {cause}" for cause, count in sorted(system.causes.items()))
        early = system.missed - system.since(SETTLED_S)[1]
        found.append(f"missed: {causes}" + (f"; {early} of them in the first second" if early else ""))
    if system.overruns:
        found.append(f"overruns: {system.overruns}, in which {system.skipped} deadlines were lost")
    if system.unseen:
        found.append(f"{system.unseen} ticks are missing from the percentiles")
    if system.interrupted:
        found.append("interrupted before its time")
    return found


def overview(cells: Sequence[Cell]) -> Table:
    """All rates and loads, one line each."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style=LABEL)
    table.add_column("Hz", justify="right")
    table.add_column("load", no_wrap=True)
    table.add_column("missed", no_wrap=True)
    for head in ("pacing\np99.9", "loop\np50", "loop\np99", "/ Zenoh\np50", "/ Zenoh\np99"):
        table.add_column(head, justify="right", no_wrap=True)
    for cell in cells:
        pacing, loop = cell.system.quantiles_us("pacing"), cell.system.quantiles_us("loop")
        ratio = cell.ratio("zenoh")
        table.add_row(
            f"{cell.hz:g}",
            LOADS[cell.load],
            drawing.misses(cell.system.missed, cell.system.miss_ratio),
            drawing.microseconds(pacing["p999"]),
            drawing.microseconds(loop["p50"]),
            drawing.microseconds(loop["p99"]),
            _times(ratio["p50"]),
            _times(ratio["p99"]),
        )
    return table


def _durations(values: Quantiles) -> list[str]:
    return [drawing.microseconds(values[name]) for name in SHARES]


def _times(value: float | None) -> Text:
    return Text("·" if value is None else f"{value:.2f} ×")


def _seconds(value: float | None) -> str:
    return "·" if value is None else f"{value:.2f} s"
