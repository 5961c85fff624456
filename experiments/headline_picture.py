"""The picture of the headline experiment: regret over G, where in a window it arises, and all settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.intervals import Interval

Floats = NDArray[np.float64]
COLOURS = ("#d1495b", "#c98a1b", "#1f78b4", "#888888")  # of the curves over G, in their order
FLAT = {"auto": "#7b5ea7", "live": "#4a9d5b"}
INSIDE = ("#222222", "#d1495b", "#888888", FLAT["auto"], FLAT["live"])
FAR = np.log2(4)  # ratios from a quarter or four times on have the full colour


class Curves(NamedTuple):
    """Regret per step over G, and of arms that have no G. A curve may end before the last G."""

    update: Sequence[int]
    over: Mapping[str, Sequence[Interval]]
    flat: Mapping[str, Interval]


class Ratio(NamedTuple):
    """Regret as a share of no hold's, and whether their paired difference's interval excludes 0."""

    value: float
    apart: bool


def draw(
    curves: Mapping[str, Curves],
    inside: Mapping[str, Floats],
    table: Mapping[str, Mapping[str, Ratio]],
    path: Path,
) -> None:
    """Write the picture as PNG; `inside` is regret by unit of the window, [W], by arm."""
    figure = Figure(figsize=(14, 5 + 0.31 * len(table)), layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(4, 1 + 0.31 * len(table)))[:, 0]
    panels = top.subplots(1, len(curves) + 1, squeeze=False)[0]
    for axes, (title, found) in zip(panels, curves.items(), strict=False):
        _over(axes, found)
        axes.set_title(f"chain, {title}, eta 0.2", fontsize=11)
    panels[0].legend(fontsize=9, frameon=False)
    panels[0].set_ylabel("regret per step, with 95 % interval", fontsize=10)
    _inside(panels[-1], inside)
    _table(bottom.subplots(), table)
    bottom.suptitle(
        "Regret as a share of that without a hold (G=20): red above, blue below; bold: the 95 % interval of "
        "their paired difference excludes 0",
        fontsize=11,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def _over(axes: Axes, curves: Curves) -> None:
    for (name, found), colour in zip(curves.over.items(), COLOURS, strict=True):
        update = curves.update[: len(found)]
        mean = np.array([one.mean for one in found])
        half = np.array([one.half for one in found])
        axes.fill_between(update, mean - half, mean + half, color=colour, alpha=0.13, linewidth=0)
        axes.plot(update, mean, "o-", color=colour, linewidth=1.6, markersize=4, label=name)
    for name, one in curves.flat.items():
        axes.axhspan(one.mean - one.half, one.mean + one.half, color=FLAT[name], alpha=0.13, linewidth=0)
        axes.axhline(one.mean, color=FLAT[name], linewidth=1.6, linestyle="--", label=name)
    axes.set(ylim=(0, None), xlabel="G, updates in a window of 20", xticks=list(curves.update))
    axes.spines[["top", "right"]].set_visible(False)


def _inside(axes: Axes, inside: Mapping[str, Floats]) -> None:
    for (name, regret), colour in zip(inside.items(), INSIDE, strict=True):
        axes.plot(np.arange(len(regret)), regret, color=colour, linewidth=1.6, label=name)
    axes.set_title("chain, period 160: where in a window", fontsize=11)
    top = 1.25 * max(regret.max() for regret in inside.values())  # room for the legend
    axes.set(ylim=(0, top), xlabel="unit of the window", xticks=range(0, 21, 5))
    axes.legend(fontsize=9, frameon=False, loc="upper center", ncols=2)
    axes.spines[["top", "right"]].set_visible(False)


def _table(axes: Axes, rows: Mapping[str, Mapping[str, Ratio]]) -> None:
    arms = list(next(iter(rows.values())))
    far = np.log2([[row[arm].value for arm in arms] for row in rows.values()])
    axes.imshow(far, cmap=mpl.colormaps["RdBu_r"], norm=Normalize(-FAR, FAR), aspect="auto")
    for y, row in enumerate(rows.values()):
        for x, arm in enumerate(arms):
            weight = "bold" if row[arm].apart else "normal"
            shade = "white" if abs(far[y, x]) > 0.65 * FAR else "black"
            text = f"{row[arm].value:.2f}"
            axes.text(x, y, text, ha="center", va="center", fontsize=8.5, weight=weight, color=shade)
    axes.set_xticks(range(len(arms)), [_stacked(arm) for arm in arms])
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set_yticks(np.arange(0.5, len(rows) - 1), minor=True)
    axes.grid(which="minor", axis="y", color="white", linewidth=2)
    axes.tick_params(which="both", length=0, labelsize=8.5)
    axes.xaxis.tick_top()
    axes.spines[:].set_visible(False)


def _stacked(arm: str) -> str:
    """A column's heading, narrow."""
    return arm.replace(" ", "\n").replace("\n%", " %").replace("_", "_\n")
