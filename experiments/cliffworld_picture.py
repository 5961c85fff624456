"""The picture of the cliffworld's experiment: three cases as curves, all of them as a table in colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from experiments.intervals import Interval

Floats = NDArray[np.float64]
COLOURS = ("#222222", "#d1495b", "#1f78b4", "#4a9d5b", "#c98a1b")  # of the arms, in their order
DASHES = ("-", "-", "--", "-", "--")
FAR = 4.0  # reward per step: differences from here on have the full colour; most are smaller


class Panel(NamedTuple):
    """Curves of one case: the steps [bins], mean and half width of the interval [bins] by arm, the switch."""

    title: str
    step: Floats
    arms: Mapping[str, tuple[Floats, Floats]]
    switch: int


class Cell(NamedTuple):
    """An arm's reward per step in one reading, and its difference to the first arm's."""

    reward: Interval
    difference: Interval


def draw(panels: Sequence[Panel], matrix: Mapping[str, Mapping[str, Mapping[str, Cell]]], path: Path) -> None:
    """Write the picture as PNG; `matrix` is by span of steps, reading and arm."""
    figure = Figure(figsize=(13, 13.5), layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(4.2, 9.3))[:, 0]
    for axes, panel in zip(top.subplots(1, len(panels), sharey=True, squeeze=False)[0], panels, strict=True):
        _curves(axes, panel)
    top.supylabel("reward per step", fontsize=10)
    top.axes[0].legend(loc="lower right", fontsize=9, frameon=False)
    top.suptitle("Mean over the six pairs, with the 95 % interval over seeds", fontsize=11)
    blocks = bottom.subplots(1, len(matrix), sharey=True, squeeze=False)[0]
    for axes, (title, rows) in zip(blocks, matrix.items(), strict=True):
        _block(axes, rows)
        axes.set_title(title, fontsize=11, pad=8)
    bottom.supylabel("pays, inactive goal, gamma, reward of a step", fontsize=10)
    bottom.suptitle(
        "Reward per step. Colour: difference to Q, red below, blue above; bold: its 95 % interval excludes 0",
        fontsize=11,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _curves(axes: Axes, panel: Panel) -> None:
    for (name, (mean, half)), colour, dash in zip(panel.arms.items(), COLOURS, DASHES, strict=True):
        axes.fill_between(panel.step, mean - half, mean + half, color=colour, alpha=0.15, linewidth=0)
        axes.plot(panel.step, mean, dash, color=colour, linewidth=1.6, label=name)
    axes.axvline(panel.switch, color="#888888", linewidth=1, linestyle=":")
    axes.set(ylim=(-9, 3), xlabel="step", xlim=(panel.step[0], panel.step[-1]))
    axes.set_title(panel.title, fontsize=11)
    axes.xaxis.set_major_locator(MultipleLocator(5000))
    axes.spines[["top", "right"]].set_visible(False)


def _block(axes: Axes, rows: Mapping[str, Mapping[str, Cell]]) -> None:
    arms = list(next(iter(rows.values())))
    far = np.array([[row[arm].difference.mean for arm in arms] for row in rows.values()])
    colours = mpl.colormaps["RdBu"]
    axes.imshow(far, cmap=colours, norm=TwoSlopeNorm(0.0, -FAR, FAR), aspect="auto")
    for y, row in enumerate(rows.values()):
        for x, arm in enumerate(arms):
            weight = "bold" if row[arm].difference.apart else "normal"
            shade = "white" if abs(far[y, x]) > 0.65 * FAR else "black"
            text = f"{row[arm].reward.mean:z.2f}"
            axes.text(x, y, text, ha="center", va="center", fontsize=8.5, weight=weight, color=shade)
    axes.set_xticks(range(len(arms)), [arm.replace(" ", "\n", 1) for arm in arms], fontsize=9)
    axes.set_yticks(range(len(rows)), list(rows), fontsize=9)
    axes.set_yticks(np.arange(0.5, len(rows) - 1), minor=True)
    axes.grid(which="minor", axis="y", color="white", linewidth=2)
    axes.tick_params(which="both", length=0)
    axes.spines[:].set_visible(False)
