"""The picture of the motivating example: what may happen, what the policies do, and what it earns them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.ramps import Ramp, average, swapped

# Okabe and Ito's colours: told apart with any kind of colour vision.
ORANGE, BLUE, GREEN, RED, BLACK, GREY = "#E69F00", "#0072B2", "#009E73", "#D55E00", "#000000", "#777777"
LOOKS = {
    "conservative": (ORANGE, "-"),
    "pessimistic": (BLUE, "-"),
    "from 0 to T": (GREY, "--"),
    "best from 0": (GREEN, "-"),
    "best": (RED, "-"),
}
LABEL_OFFSETS = {
    "conservative": (-68, 4),
    "pessimistic": (9, 1),
    "from 0 to T": (-62, -12),
    "best from 0": (-24, -15),
}
SWITCH = 45  # the unit of the switch that is drawn as an example


def draw(
    path: Path, units: int, ramps: Mapping[str, Ramp], points: Mapping[str, tuple[float, float]]
) -> None:
    """Write the picture as PNG.

    Args:
        path: where to.
        units: T.
        ramps: policies by name, of those in `LOOKS`.
        points: what runs say of each policy's expected average reward, and half its interval.
    """
    figure = Figure(figsize=(12.0, 3.9), dpi=130, layout="constrained")
    world, policy, reward = figure.subplots(1, 3, width_ratios=[1, 1, 1.35])
    _world(world, units)
    _policies(policy, units, ramps)
    _rewards(reward, units, ramps, points)
    for axes in (world, policy, reward):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, metadata={"Software": None})


def _world(axes: Axes, units: int) -> None:
    t = np.arange(units)
    first = (t >= SWITCH).astype(float)
    axes.step(t, 1 - first, where="post", color=BLACK, label="arm $a_1$, one run")
    axes.step(t, first, where="post", color=RED, label="arm $a_0$, same run")
    axes.plot(t, swapped(units), color=GREY, linestyle=":", label="P(switch has come)")
    axes.set(title="What the arms pay", xlabel="unit $t$", ylabel="reward", ylim=(-0.05, 1.35), yticks=[0, 1])
    axes.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)


def _policies(axes: Axes, units: int, ramps: Mapping[str, Ramp]) -> None:
    for name, ramp in ramps.items():
        colour, style = LOOKS[name]
        axes.plot(ramp.beta(units), color=colour, linestyle=style, label=name)
    axes.set(title=r"Policies $\beta_t$ = P(arm $a_0$)", xlabel="unit $t$", ylim=(-0.05, 1.35), yticks=[0, 1])
    axes.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)


def _rewards(
    axes: Axes, units: int, ramps: Mapping[str, Ramp], points: Mapping[str, tuple[float, float]]
) -> None:
    spans = range(1, units + 1)
    curves = {
        "beginning at 0": (GREEN, [Ramp(0, span) for span in spans]),
        f"beginning at {ramps['pessimistic'].begin}": (
            BLUE,
            [Ramp(ramps["pessimistic"].begin, span) for span in spans],
        ),
        f"around the middle, {units // 2}": (RED, [Ramp((units - span) // 2, span) for span in spans]),
    }
    for label, (colour, family) in curves.items():
        values = average(np.array([ramp.beta(units) for ramp in family]))
        axes.plot(spans, values, color=colour, label=label)
    for name, (value, half) in points.items():
        axes.errorbar(ramps[name].span, value, half, color=LOOKS[name][0], marker="o", capsize=3)
        axes.annotate(
            name,
            (ramps[name].span, value),
            LABEL_OFFSETS.get(name, (6, 5)),
            textcoords="offset points",
            fontsize=8,
        )
    axes.set(
        title="Expected average reward by tempo (points: runs)",
        xlabel="span of the ramp, units: fast to slow",
    )
    axes.legend(frameon=False, fontsize=8, loc="lower right")
