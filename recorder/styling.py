"""How series look. Kept in the data, not in the dashboard: any layout then has the same looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import rerun as rr

from recorder.telemetry import FORECAST
from recorder.ticks import MISSED, PHYSICS, PHYSICS_SERIES
from rtcore.messages import CAUSES

BLUE, ORANGE, GREEN = 0x4E9BFFFF, 0xFFA23AFF, 0x3ECF8EFF
RED, PURPLE, GREY, YELLOW = 0xFF5A5FFF, 0xB18CFFFF, 0x9AA4B2FF, 0xFFE066FF
DOT_SIZE = 3.0
JUDGED = ("last_error", "last_baseline_error", "trust")  # of the forecast's gauges
PALETTE = (BLUE, ORANGE, GREEN, PURPLE, RED, GREY)

Drawing = Literal["Average", "Max", "Steps", "Dots", "Line and dots"]


@dataclass(frozen=True, slots=True)
class Look:
    """Names and colours of an entity's series, and what zooming out may do to them.

    `Average` is for quantities whose mean matters. `Max` is for latencies and misses: the default
    would draw a single spike at half its height (measured). `Steps` holds a value until the next one,
    `Dots` are for events.
    """

    names: tuple[str, ...]
    colours: tuple[int, ...]
    drawing: Drawing = "Average"
    width: float = 1.5
    hidden: tuple[bool, ...] = ()  # until somebody ticks them in the legend; (): none


LOOKS: dict[str, Look] = {
    "/env/reward": Look(("reward",), (BLUE,), width=1.0),
    "/env/return": Look(("return",), (GREEN,), "Line and dots"),
    "/env/pacing_us": Look(("pacing error",), (GREY,), "Max"),
    PHYSICS: Look(PHYSICS_SERIES, (ORANGE, GREEN, PURPLE), "Steps"),
    "/agent/loop_us": Look(("loop",), (ORANGE,), "Max"),
    "/agent/reaction_us": Look(("agent's reaction",), (BLUE,), "Max"),
    MISSED: Look(("missed",), (RED,), "Max"),
    **{
        f"{MISSED}/{cause}": Look((cause,), (colour,), "Dots")
        for cause, colour in zip(CAUSES, (GREY, PURPLE, ORANGE, GREEN, YELLOW, BLUE, RED), strict=True)
    },
    "/agent/policy_version": Look(("acting",), (ORANGE,), "Steps"),
    "/learner/published_version": Look(("published",), (BLUE,), "Dots"),
    "/learner/schedule/update": Look(("update G",), (BLUE,), "Steps"),
    "/learner/schedule/hold": Look(("hold N",), (ORANGE,), "Steps"),
    "/learner/loss/critic": Look(("critic",), (BLUE,)),
    "/learner/loss/actor": Look(("actor",), (ORANGE,)),
    "/learner/loss/alpha": Look(("temperature",), (PURPLE,)),
    "/learner/alpha": Look(("temperature alpha",), (PURPLE,)),
    "/learner/entropy": Look(("entropy",), (GREEN,)),
    "/learner/q_mean": Look(("mean Q",), (GREEN,)),
    "/learner/updates_per_s": Look(("updates per s",), (GREY,)),
}
TARGET = Look(("target",), (ORANGE,), "Steps", width=2.5)
TARGET_AND_SPEED = Look(("target", "reached"), (ORANGE, BLUE), width=1.5)


def looks(look: Look) -> list[rr.AsComponents]:
    """The static archetypes of a look."""
    names, colours = list(look.names), np.array(look.colours, np.uint32)
    dots = rr.SeriesPoints(names=names, colors=colours, markers="Circle", marker_sizes=[DOT_SIZE])
    if look.drawing == "Dots":
        return [dots]
    lines = rr.SeriesLines(
        names=names,
        colors=colours,
        widths=[look.width] * len(names),
        visible_series=[not hidden for hidden in look.hidden] or None,
        aggregation_policy="Max" if look.drawing == "Max" else "Average",
        interpolation_mode="StepAfter" if look.drawing == "Steps" else "Linear",
    )
    return [lines, dots] if look.drawing == "Line and dots" else [lines]


def forecast_look(names: Sequence[str]) -> Look:
    """The forecast's gauges, in the order in which they turned up; only those of `JUDGED` are not hidden."""
    colours = tuple(PALETTE[i % len(PALETTE)] for i in range(len(names)))
    return Look(tuple(names), colours, hidden=tuple(name not in JUDGED for name in names))


def static_looks(*, drift_is_speed: bool) -> dict[str, list[rr.AsComponents]]:
    """Everything that can be said before the first row; `FORECAST` follows when its series are known."""
    static = {entity: looks(look) for entity, look in LOOKS.items()}
    static["/env/drift"] = looks(TARGET_AND_SPEED if drift_is_speed else TARGET)
    static["/learner/phase"] = [
        rr.StateConfiguration(
            values=["update", "hold"],
            labels=["update", "hold"],
            colors=np.array([BLUE, ORANGE], np.uint32),
        )
    ]
    assert FORECAST not in static
    return static
