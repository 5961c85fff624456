"""The picture of `tenuto latency`: for each rate, how many ticks were slower than what, and when.

Left, the share of ticks whose loop took longer than x, on logarithmic axes, so that p50, p99 and p99.9
are read off equally well. Right, the loop over the run, with the misses.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from launcher.echo.links import Transport
from launcher.latency.results import Cell, Results
from launcher.latency.table import ECHOES, LOADS
from launcher.latency.trial import Load, Trial
from launcher.quantiles import Nanoseconds

# Okabe and Ito's colours: told apart with any kind of colour vision, and in grey by the line's style.
LOOP, MISS, GREY = "#0072B2", "#D55E00", "#555555"
ECHO_COLOURS: dict[Transport, str] = {"zenoh": "#E69F00", "unix": "#009E73"}
STYLES: dict[Load, Literal["-", "--"]] = {"learner": "-", "none": "--"}
MARKS = {0.5: "p50", 0.01: "p99", 0.001: "p99.9"}
BINS = 200  # along the time line: one a pixel or two would hide that a peak is a single tick

Floats = npt.NDArray[np.float64]


def draw(results: Results, path: Path) -> None:
    """Write the picture as PNG. Without a cell there is nothing to draw, and nothing is written."""
    rates = [(hz, list(cells)) for hz, cells in groupby(results.cells, key=lambda cell: cell.hz)]
    if not rates:
        return
    figure, axes = _frame(len(rates))
    for (hz, cells), (left, right) in zip(rates, axes, strict=True):
        _slower_than(left, hz, cells)
        _over_time(right, hz, cells)
    axes[-1][0].set_xlabel("loop latency or round trip, µs")
    axes[-1][1].set_xlabel("run time, s")
    handles = _legend(results.cells)
    figure.legend(handles=handles, loc="lower center", ncols=3, frameon=False, fontsize=9)
    figure.text(0.01, 0.995, _title(results), ha="left", va="top", fontsize=11)
    figure.savefig(path, metadata={"Software": None})


def survival(latency_ns: Nanoseconds) -> tuple[Floats, Floats]:
    """(x in µs, rising; share of all values above x). The largest has the share of one, so that it shows."""
    ordered = np.sort(latency_ns[latency_ns >= 0]) / 1e3
    above = 1.0 - np.arange(1, len(ordered) + 1) / max(1, len(ordered))
    if len(above):
        above[-1] = 1.0 / len(above)
    return ordered, above


def envelope(seconds: Floats, values: Floats, bins: int = BINS) -> tuple[Floats, Floats, Floats]:
    """(middle, median, largest) of the values in each of `bins` equal spans of time that has any."""
    if not len(seconds):
        return seconds, values, values
    edges = np.linspace(0.0, max(float(seconds[-1]), 1e-9), bins + 1)
    where = np.clip(np.searchsorted(edges, seconds, side="right") - 1, 0, bins - 1)
    found = [(index, values[where == index]) for index in np.unique(where)]
    middles = np.array([(edges[index] + edges[index + 1]) / 2 for index, _ in found])
    return middles, np.array([np.median(v) for _, v in found]), np.array([v.max() for _, v in found])


def _frame(rows: int) -> tuple[Figure, npt.NDArray[np.object_]]:
    """The figure and its axes, [rows, 2], with margins of the same size in inches for any number of rows."""
    top, row, bottom, gap = 0.85, 2.3, 1.3, 0.65
    height = top + rows * row + (rows - 1) * gap + bottom
    figure = Figure(figsize=(13.0, height), dpi=130)
    axes = figure.subplots(
        rows,
        2,
        squeeze=False,
        sharex="col",
        width_ratios=(1.0, 1.5),
        gridspec_kw={
            "left": 0.065, "right": 0.985, "wspace": 0.16,
            "top": 1 - top / height, "bottom": bottom / height, "hspace": gap / row,
        },
    )  # fmt: skip
    for one in axes.flat:
        one.tick_params(labelbottom=True, labelsize=9)
    return figure, axes


def _in_microseconds(axis: Axis) -> None:
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axis.set_minor_formatter(NullFormatter())


def _slower_than(axes: Axes, hz: float, cells: Sequence[Cell]) -> None:
    smallest = 1.0
    for cell in cells:
        style = STYLES[cell.load]
        curves = [(cell.system.loop_ns, LOOP, 2.0)]
        curves += [(echo.latency_ns, ECHO_COLOURS[name], 1.4) for name, echo in cell.echoes.items()]
        for latency_ns, colour, width in curves:
            x, above = survival(latency_ns)
            if len(x):
                axes.plot(x, above, style, color=colour, linewidth=width)
                smallest = min(smallest, float(above[-1]))
    axes.axvline(1e6 / hz, color=MISS, linewidth=1.0, linestyle=":")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(smallest / 1.5, 1.2)
    axes.set_ylabel("share of ticks slower")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:g} %"))
    axes.set_title(f"{hz:g} Hz: a deadline every {_period(hz)}", loc="left", fontsize=10, fontweight="bold")
    _in_microseconds(axes.xaxis)
    axes.grid(which="major", color="#dddddd", linewidth=0.6)
    for share, name in MARKS.items():
        if share >= smallest / 1.5:
            axes.axhline(share, color="#bbbbbb", linewidth=0.8, zorder=0)
            axes.text(
                0.01, share, name, transform=axes.get_yaxis_transform(), ha="left", va="bottom", fontsize=8,
                color=GREY,
            )  # fmt: skip


def _over_time(axes: Axes, hz: float, cells: Sequence[Cell]) -> None:
    """The most loaded cell of a rate: the median and the largest loop of each span, and every miss."""
    cell = max(cells, key=lambda one: one.load == "learner")
    trial = cell.system
    seconds, loop_us = _series(trial)
    middles, median, largest = envelope(seconds, loop_us)
    axes.fill_between(middles, median, largest, color=LOOP, alpha=0.25, linewidth=0)
    axes.plot(middles, largest, color=LOOP, linewidth=0.7, alpha=0.8)
    axes.plot(middles, median, color=LOOP, linewidth=1.6)
    axes.axhline(1e6 / hz, color=MISS, linewidth=1.0, linestyle=":")
    missed_s = trial.tick[trial.was_missed] / hz
    axes.plot(
        missed_s, np.full(len(missed_s), 0.965), "v", color=MISS, markersize=6, clip_on=False,
        transform=axes.get_xaxis_transform(),
    )  # fmt: skip
    axes.set_yscale("log")
    high = max([1e6 / hz, *largest[-1:], float(largest.max()) if len(largest) else 0.0])
    axes.set_ylim(top=2.5 * high)  # room for the misses
    axes.set_xlim(0.0, max(float(seconds[-1]) if len(seconds) else 0.0, 1.0))
    _in_microseconds(axes.yaxis)
    axes.set_ylabel("loop latency, µs")
    axes.grid(which="major", color="#dddddd", linewidth=0.6)
    count = f"{trial.missed:,} of {trial.ticks:,} ticks missed"
    steal = "" if trial.steal_s is None else f"; steal {trial.steal_s:.2f} s"
    axes.set_title(f"{LOADS[cell.load]}: {count}{steal}", loc="left", fontsize=10)


def _series(trial: Trial) -> tuple[Floats, Floats]:
    """(seconds, µs) of the ticks that have a loop latency."""
    known = trial.loop_ns >= 0
    return trial.tick[known] / trial.hz, trial.loop_ns[known] / 1e3


def _legend(cells: Sequence[Cell]) -> list[Artist]:
    loads = [load for load in STYLES if any(cell.load == load for cell in cells)]
    handles: list[Artist] = []
    for load in loads:
        style = STYLES[load]
        handles.append(
            Line2D([], [], color=LOOP, linestyle=style, linewidth=2, label=f"Tenuto's loop, {LOADS[load]}")
        )
        for transport, label in ECHOES.items():
            if any(cell.load == load and transport in cell.echoes for cell in cells):
                handles.append(
                    Line2D(
                        [],
                        [],
                        color=ECHO_COLOURS[transport],
                        linestyle=style,
                        label=f"{label}, {LOADS[load]}",
                    )
                )
    handles.append(Patch(color=LOOP, alpha=0.25, label=f"median to largest, {BINS} spans of time"))
    handles.append(Line2D([], [], color=MISS, linestyle=":", label="one period"))
    handles.append(Line2D([], [], color=MISS, linestyle="", marker="v", label="missed deadline"))
    return handles


def _title(results: Results) -> str:
    machine, options = results.machine, results.options
    first = f"Observation sent to action received: {options['env']}, rt = {options['rt']}"
    return (
        f"{first}\n{machine['processor']}, {machine['cores']} cores, Linux {machine['kernel']}, {results.at}"
    )


def _period(hz: float) -> str:
    milliseconds = 1e3 / hz
    return f"{milliseconds:g} ms" if milliseconds >= 1 else f"{1e3 * milliseconds:g} µs"
