"""How series look. Kept in the data, not in the dashboard: any layout then has the same looks."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import rerun as rr

from recorder.telemetry import FORECAST
from recorder.ticks import MISSED, PHYSICS, PHYSICS_SERIES
from rtcore.messages import CAUSES

BLUE, ORANGE, GREEN = 0x4E9BFFFF, 0xFFA23AFF, 0x3ECF8EFF
RED, PURPLE, GREY, YELLOW = 0xFF5A5FFF, 0xB18CFFFF, 0x9AA4B2FF, 0xFFE066FF
WHITE, CYAN, PINK, LIME = 0xF2F4F8FF, 0x40D8E0FF, 0xFF8AC4FF, 0xA6D64AFF
FLEET = (BLUE, ORANGE, GREEN, PURPLE, CYAN, PINK, YELLOW, LIME)  # by environment; then `GOLDEN` goes on
GOLDEN = 0.61803  # of the circle from one hue to the next: they never meet
DOT_SIZE = 3.0
JUDGED = ("last_error", "last_baseline_error", "trust")  # of the forecast's gauges
PALETTE = (BLUE, ORANGE, GREEN, PURPLE, RED, GREY)

PUBLISHED = "/learner/published_version"

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
    PUBLISHED: Look(("published",), (BLUE,), "Dots"),
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


def learner_looks(*, fleet: bool = False) -> dict[str, list[rr.AsComponents]]:
    """What can be said of the learner's entities before their first rows; `FORECAST` follows when its series
    are known. In a fleet the colours are the environments' where both are in one view.
    """
    own = {entity: look for entity, look in LOOKS.items() if entity.startswith("/learner/")}
    if fleet:
        own[PUBLISHED] = replace(own[PUBLISHED], colours=(WHITE,))
    static = {entity: looks(look) for entity, look in own.items()}
    static["/learner/phase"] = [
        rr.StateConfiguration(
            values=["update", "hold"],
            labels=["update", "hold"],
            colors=np.array([BLUE, ORANGE], np.uint32),
        )
    ]
    assert FORECAST not in static
    return static


def env_looks(*, drift_is_speed: bool) -> dict[str, list[rr.AsComponents]]:
    """Of the only environment's entities, and its agent's."""
    static = {entity: looks(look) for entity, look in LOOKS.items() if not entity.startswith("/learner/")}
    static["/env/drift"] = looks(TARGET_AND_SPEED if drift_is_speed else TARGET)
    return static


def fleet_looks(env: str, index: int, *, drift_is_speed: bool) -> dict[str, list[rr.AsComponents]]:
    """Of one environment of a fleet: series of a kind share a view, so they are told apart by the name and a
    colour of their environment, the same in every view.

    What is the same for all, such as the target, is drawn once, for the first.
    """
    colour = fleet_colour(index)
    own = {entity: _one_of_many(look, env, colour) for entity, look in LOOKS.items()}
    causes = {
        f"{MISSED}/{cause}": replace(LOOKS[f"{MISSED}/{cause}"], names=(f"{env} {cause}",))
        for cause in CAUSES
    }
    drift = TARGET
    if drift_is_speed:
        drift = Look(("target", env), (WHITE, colour), hidden=(index > 0, False))
    kept = {PHYSICS: LOOKS[PHYSICS], **causes, "/env/drift": drift}
    return {
        entity: looks(look) for entity, look in (own | kept).items() if not entity.startswith("/learner/")
    }


def _one_of_many(look: Look, env: str, colour: int) -> Look:
    return replace(look, names=(env,), colours=(colour,))


def fleet_colour(index: int) -> int:
    """RGBA; neighbours differ most. Each hue comes once, and those of the first eight lie apart widely."""
    return FLEET[index] if index < len(FLEET) else _hue(index)


def _hue(index: int) -> int:
    red, green, blue = colorsys.hsv_to_rgb(index * GOLDEN % 1.0, 0.45, 0.95)
    return int.from_bytes((round(255 * red), round(255 * green), round(255 * blue), 255))
