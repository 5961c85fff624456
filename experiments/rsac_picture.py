"""The picture of the `rsac` comparison: paired differences with their intervals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.intervals import Interval

# Okabe and Ito's colours: told apart with any kind of colour vision.
LOOKS = {"declared": ("#0072B2", "o", "declared family"), "learned": ("#D55E00", "s", "learned family")}
PANELS = {
    "relabelled - SAC": ("relabelled", "SAC", "Relabelling alone, against tuned SAC"),
    "forecast - SAC": ("forecast", "SAC", "Relabelling with the forecast, against tuned SAC"),
    "forecast - relabelled": ("forecast", "relabelled", "What the forecast adds to relabelling"),
}
_SHIFT = 0.11  # between the two models of one drift

Differences = Mapping[str, Mapping[str, Interval]]  # by drift, then by "method - baseline"


def draw(path: Path, found: Mapping[str, Differences]) -> None:
    """Write the picture as PNG: three panels of the first comparison, and the last panel of the others.

    Args:
        path: where to.
        found: differences by comparison; the first is the main one.
    """
    main, *others = found.items()
    figure = Figure(figsize=(3.9 * (3 + len(others)), 3.4), dpi=130, layout="constrained")
    panels = figure.subplots(1, 3 + len(others), squeeze=False)[0]
    for axes, (method, baseline, title) in zip(panels, PANELS.values(), strict=False):
        _panel(axes, main[1], method, baseline, title)
    for axes, (name, differences) in zip(panels[3:], others, strict=True):
        _panel(axes, differences, "forecast", "relabelled", f"The same, policy {name}")
    panels[0].set_ylabel("drift")
    panels[0].legend(frameon=False, fontsize=8, loc="best")
    figure.savefig(path, metadata={"Software": None})


def _panel(axes: Axes, differences: Differences, method: str, baseline: str, title: str) -> None:
    """Points with intervals, a row per drift, the first on top."""
    axes.axvline(0.0, color="#777777", linewidth=1)
    for shift, (model, (colour, marker, label)) in zip((_SHIFT, -_SHIFT), LOOKS.items(), strict=True):
        name = f"{model}, {method} - {baseline if baseline == 'SAC' else f'{model}, {baseline}'}"
        rows = [(row, by[name]) for row, by in enumerate(differences.values()) if name in by]
        if rows:
            axes.errorbar(
                [one.mean for _, one in rows],
                [-row + shift for row, _ in rows],
                xerr=[one.half for _, one in rows],
                fmt=marker,
                color=colour,
                capsize=3,
                markersize=5,
                label=label,
            )
    axes.set_yticks([-row for row in range(len(differences))], list(differences))
    axes.set_ylim(-len(differences) + 0.5, 0.5)
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("difference in reward per tick, 95 % interval", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
