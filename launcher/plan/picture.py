"""The pictures of `tenuto plan`: the terms of one plan over N, and the paper's panels with its example."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from launcher.plan.constants import Plan
from launcher.plan.envelope import Envelope
from launcher.plan.panels import EXAMPLE_CHANGES, EXAMPLE_WINDOW, Curve, Panel, example
from launcher.plan.results import CAVEAT, terms
from learner.theory.optimum import best_environment_split, best_policy_split, best_split

# Okabe and Ito's colours: told apart with any kind of colour vision.
POLICY, ENVIRONMENT, SUM, GREY = "#0072B2", "#D55E00", "#222222", "#555555"
UPDATE, HOLD = "#009E73", "#CC79A7"
SAMPLES = 200  # of an envelope


def draw_plan(plan: Plan, path: Path) -> None:
    """The terms over N with their minima; beside it, for a run, the budgets and their envelopes. As PNG."""
    beside = plan.envelopes is not None
    figure = Figure(figsize=(12.0 if beside else 7.5, 5.2), dpi=120, layout="constrained")
    axes = figure.subplots(1, 2 if beside else 1, squeeze=False)[0]
    _plan_terms(axes[0], plan)
    if plan.envelopes is not None:
        _envelopes(axes[1], plan.envelopes)
    figure.supxlabel(_wrapped(CAVEAT, 150 if beside else 95), fontsize=8, color=GREY)
    figure.savefig(path, metadata={"Software": None})


def draw_panels(panels: Sequence[Panel], path: Path) -> None:
    """The four panels, and below them the example of a budget. As PNG."""
    figure = Figure(figsize=(11.0, 12.2), dpi=110, layout="constrained")
    rows = figure.subplots(3, 2)
    for axes, panel in zip(rows[:2].flat, panels, strict=True):
        _panel(axes, panel)
    _example_reward(rows[2][0])
    _example_budget(rows[2][1])
    figure.supxlabel(_wrapped(CAVEAT, 140), fontsize=9, color=GREY)
    figure.savefig(path, metadata={"Software": None})


def _plan_terms(axes: Axes, plan: Plan) -> None:
    problem = plan.problem
    hold, _, policy, environment, both = (np.array(column) for column in zip(*terms(problem), strict=True))
    curves = (
        (policy, POLICY, r"$R^{\pi}$", best_policy_split(problem)),
        (environment, ENVIRONMENT, r"$R^{env}$", best_environment_split(problem)),
        (both, SUM, r"$R^{\pi} + R^{env}$", best_split(problem)),
    )
    for values, colour, label, best in curves:
        axes.plot(hold, values, color=colour, linewidth=1.8, label=f"{label}, least at N = {best.hold}")
        axes.plot(best.hold, values[best.hold], "D", color=colour, markersize=7, clip_on=False, zorder=5)
    best = best_split(problem)
    _title(axes, f"N* = {best.hold}, G* = {best.update}, $\\gamma_f$* = {best.update_share:.3g}", "")
    axes.set(xlabel="N, units of hold", ylabel="term of the bound", xlim=(0, problem.window), ylim=(0, None))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(frameon=False, fontsize=9)


def _envelopes(axes: Axes, envelopes: tuple[Envelope, Envelope]) -> None:
    for envelope, colour, phase in zip(envelopes, (UPDATE, HOLD), ("update", "hold"), strict=True):
        ahead = np.arange(len(envelope.budget))
        fine = np.linspace(0, len(envelope.budget) - 1, SAMPLES)
        curve = envelope.scale * envelope.growth**fine
        label = f"{phase}: {envelope.scale:.3g} × {envelope.growth:.4g}$^j$"
        axes.plot(fine, curve, color=colour, linewidth=1.8, label=label)
        axes.plot(ahead, envelope.budget, "." if phase == "update" else "x", color=colour, markersize=6)
    _title(
        axes, "Budget since a phase began", "dots, crosses: the largest of the run; lines: fitted envelopes"
    )
    axes.set(xlabel="j, units since then", ylabel="B(t, t + j)", ylim=(0, None))
    axes.legend(frameon=False, fontsize=9)


def _panel(axes: Axes, panel: Panel) -> None:
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.85, len(panel.curves)))
    for curve, colour in zip(panel.curves, colours, strict=True):
        values = np.array(curve.values)
        if panel.relative:
            values /= values.max()
        axes.plot(values, color=colour, linewidth=1.6, label=_legend(curve))
        axes.plot(curve.best.hold, values[curve.best.hold], "D", color=colour, markersize=7, zorder=5)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True, steps=[1, 2, 5, 10]))
    _title(axes, panel.title, panel.setting)
    axes.set(xlabel="N", ylabel="bound / its largest value" if panel.relative else "bound")
    if panel.logarithmic:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.legend(
            frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(0.02, 0.7)
        )  # between curves
    else:
        axes.legend(frameon=False, fontsize=9)


def _legend(curve: Curve) -> str:
    ties = curve.best.ties
    return f"{curve.label}: N* = {ties[0]}" + (f" (and {ties[1]})" if len(ties) > 1 else "")


def _example_reward(axes: Axes) -> None:
    units = np.arange(EXAMPLE_WINDOW + 1)
    reward = np.concatenate(([0.0], np.cumsum(EXAMPLE_CHANGES)))
    axes.stairs(reward, units, color=SUM, linewidth=2, baseline=None)
    for update, low in ((4, -0.16), (6, -0.32)):
        axes.barh(low, update, height=0.12, left=0, color=UPDATE)
        axes.barh(low, EXAMPLE_WINDOW - update, height=0.12, left=update, color=HOLD)
        held = f"G = {update}, N = {EXAMPLE_WINDOW - update}: sum {example()[update]:g}"
        axes.text(0.08, low, held, va="center", fontsize=9, color="white")
    axes.text(4.08, -0.16, "hold", va="center", fontsize=9, color="white")
    _title(axes, r"Example: the reward at $(s_0, a_0)$", "the only path with the paper's three sums")
    axes.set(
        xlabel="unit t", ylabel="reward", xlim=(0, EXAMPLE_WINDOW), yticks=(0, 0.5, 1), ylim=(-0.42, 1.1)
    )


def _example_budget(axes: Axes) -> None:
    sums = example()
    axes.plot(sums, color=SUM, linewidth=1.6, marker="o", markersize=4)
    least = [update for update, value in enumerate(sums) if value == min(sums)]
    axes.plot(least, [min(sums)] * len(least), "D", color=SUM, markersize=8)
    _title(axes, r"Example: $\bar{B}$ of the update and the hold", "least at G = 2 and G = 4, N = 6 - G")
    axes.set(xlabel="G", ylabel=r"$\bar{B}(0, G) + \bar{B}(G, 6)$", ylim=(0, 3.2), xticks=range(len(sums)))


def _title(axes: Axes, title: str, setting: str) -> None:
    axes.set_title(title + (f"\n{setting}" if setting else ""), loc="left", fontsize=10.5)
    axes.grid(color="#e4e4e4", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _wrapped(text: str, width: int) -> str:
    return "\n".join(textwrap.wrap(text, width))
