"""The picture of a schedule that follows its world: the drift, N, what was predicted, and the trust."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.follow_runs import PARTS, UNIT_S, WINDOW, Chosen, Course, Floats
from learner.schedule.plan import LEAST_TRUST

# Okabe and Ito's colours: told apart with any kind of colour vision.
ORANGE, BLUE, GREEN, RED, GREY = "#E69F00", "#0072B2", "#009E73", "#D55E00", "#777777"


def draw(path: Path, course: Course, chosen: Sequence[Chosen], mean: Floats, half: Floats) -> None:
    """Write the picture as PNG: four panels over run time.

    Args:
        path: where to.
        course: of the world.
        chosen: of the recorded run.
        mean: N of each window over the seeds, [windows].
        half: half of its interval.
    """
    figure = Figure(figsize=(9.5, 8.2), dpi=130, layout="constrained")
    drift, hold, regret, trust = figure.subplots(4, 1, sharex=True, height_ratios=[1, 1.6, 1.6, 1])
    drift.plot(UNIT_S * np.arange(PARTS * course.part), course.drift(), color=GREY)
    drift.set(ylabel="drift", title="The world")
    _holds(hold, chosen, mean, half)
    _regret(regret, chosen)
    _step(trust, [one.trust for one in chosen], color=BLUE)
    trust.axhline(LEAST_TRUST, color=GREY, linestyle=":", linewidth=1)
    trust.set(
        ylabel="trust", ylim=(-0.05, 1.05), xlabel="run time, s", title="Change that is told from noise"
    )
    for axes in (drift, hold, regret, trust):
        for part in range(1, PARTS):
            axes.axvline(part * course.part * UNIT_S, color=GREY, linewidth=0.8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0.01)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Software": None})


def _holds(axes: Axes, chosen: Sequence[Chosen], mean: Floats, half: Floats) -> None:
    edges = WINDOW * UNIT_S * np.arange(len(chosen) + 1)
    axes.stairs([one.hold for one in chosen], edges, fill=True, color=ORANGE, alpha=0.6, label="this run")
    _step(axes, mean.tolist(), color=BLUE, label="mean over seeds, 95 %")
    low, high = np.maximum(mean - half, 0), np.minimum(mean + half, WINDOW - 1)
    axes.fill_between(edges, np.append(low, low[-1]), np.append(high, high[-1]), step="post", alpha=0.25)
    axes.set(ylabel="N, units", ylim=(0, WINDOW), title=f"Hold in each window of {WINDOW} units")
    axes.legend(frameon=False, fontsize=8, loc="upper right")


def _regret(axes: Axes, chosen: Sequence[Chosen]) -> None:
    _step(axes, [one.unheld for one in chosen], color=RED, label="predicted without a hold")
    _step(axes, [one.predicted for one in chosen], color=GREEN, label="predicted as chosen")
    _step(axes, [one.realised for one in chosen], color=GREY, linestyle=":", label="realised")
    axes.set(yscale="log", ylabel="regret of a window", title="By forecasts, and by the tables that came")
    axes.legend(frameon=False, fontsize=8, loc="upper right", ncols=3)


def _step(axes: Axes, values: Sequence[float], **look: object) -> None:
    """A value per window, drawn over the window."""
    edges = WINDOW * UNIT_S * np.arange(len(values) + 1)
    axes.step(edges, [*values, values[-1]], where="post", **look)  # type: ignore[arg-type]
