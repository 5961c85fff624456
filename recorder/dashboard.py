"""What a viewer opens with: the blueprint that is embedded in every recording.

Left, what the robot does and what was said; middle, whether it does it well; right, whether it does it
in time and on which policy. A recording shows the whole run, a live view the last half minute.
"""

from __future__ import annotations

from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from recorder.scene import FOLLOW, ROOT, Camera
from recorder.telemetry import FORECAST
from recorder.ticks import MISSED, PHYSICS
from rtcore.messages import CAUSES, Spec

LIVE_WINDOW_S = 30.0
SHOWN_LEVELS = ["INFO", "WARN", "ERROR"]  # DEBUG lines are in the recording, one click away
BACKGROUND = [24, 26, 30]


def dashboard(
    spec: Spec, camera: Camera | None, *, drift_is_speed: bool, live: bool = False
) -> rrb.Blueprint:
    """The layout.

    Args:
        spec: names the environment and its deadline in the titles.
        camera: of the 3-D view; None: no 3-D.
        drift_is_speed: whether `/env/drift` is a target speed.
        live: follow the end of a running stream instead of showing everything.
    """
    plots = Plots(live)
    columns: list[Any] = [
        _left(spec, camera),
        rrb.Vertical(*_middle(plots, drift_is_speed=drift_is_speed), row_shares=[0.8, 2, 2, 2]),
        rrb.Vertical(*_right(plots, spec), row_shares=[2, 0.8, 2, 2]),
    ]
    return page(rrb.Horizontal(*columns, column_shares=[1, 1, 1]))


def page(layout: Any) -> rrb.Blueprint:
    """A layout with the panels around it out of the way."""
    return rrb.Blueprint(
        layout,
        rrb.TimePanel(state="collapsed", timeline="run_time", play_state="following"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def log_view() -> Any:
    """What was said."""
    return rrb.TextLogView(
        origin="/log",
        name="Log of all processes",
        rows=rrb.TextLogRows(filter_by_log_level=SHOWN_LEVELS),
        columns=rrb.TextLogColumns(timeline_columns=["run_time"], text_log_columns=["LogLevel", "Body"]),
    )


def run_card_view() -> Any:
    """What this is of."""
    return rrb.TextDocumentView(origin="/run_card", name="Run card")


def world_view(name: str, camera: Camera, root: str = "") -> Any:
    """The world in 3-D, of the environment whose entities lie below `root`."""
    return rrb.Spatial3DView(
        origin=root + FOLLOW,
        contents=f"{root}{ROOT}/**",
        name=name,
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=camera.eye, look_target=camera.target
        ),
    )


def _left(spec: Spec, camera: Camera | None) -> Any:
    card, log = run_card_view(), log_view()
    if camera is None:
        return rrb.Vertical(card, log, row_shares=[1, 1])
    world = world_view(f"World: {spec.env_id}", camera)
    return rrb.Vertical(world, rrb.Tabs(log, card), row_shares=[3, 2])


def _middle(plots: Plots, *, drift_is_speed: bool) -> list[Any]:
    return [
        plots.states("Learner's phase", "/learner/phase"),
        plots.lines("Drifting target and speed reached, m/s", "/env/drift", legend=True)
        if drift_is_speed
        else plots.lines("Drift", "/env/drift", PHYSICS, legend=True),
        plots.lines("Return per episode", "/env/return"),
        plots.lines("Reward per tick", "/env/reward"),
    ]


def _right(plots: Plots, spec: Spec) -> list[Any]:
    latency = f"Latency, µs (deadline {spec.tick_ns / 1e3:,.0f})"
    return [
        plots.lines(latency, "/agent/loop_us", "/agent/reaction_us", "/env/pacing_us", legend=True),
        plots.lines("Missed deadlines", MISSED, *(f"{MISSED}/{cause}" for cause in CAUSES), legend=True),
        plots.lines("Policy version", "/learner/published_version", "/agent/policy_version", legend=True),
        rrb.Tabs(*learner_plots(plots, spec)),
    ]


def learner_plots(plots: Plots, spec: Spec) -> list[Any]:
    """What the learner says of itself; one of them is looked at at a time."""
    return [
        plots.lines("Losses", "/learner/loss/**", legend=True),
        plots.lines("Forecast", FORECAST, legend=True),
        plots.lines("Window, units", "/learner/schedule/update", "/learner/schedule/hold", legend=True),
        plots.lines("Mean Q", "/learner/q_mean"),
        *([] if spec.states else [plots.lines("Temperature", "/learner/alpha")]),  # tables have none
        plots.lines("Entropy", "/learner/entropy"),
        plots.lines("Updates per s", "/learner/updates_per_s"),
    ]


class Plots:
    """Makes views over run time: of the whole run, or of its last half minute.

    Their axes are not linked: a linked axis shows the half minute around the cursor, whatever range it is
    given (rerun 0.41).
    """

    def __init__(self, live: bool) -> None:
        bound = rr.TimeRangeBoundary
        start, end = bound.absolute(seconds=0.0), bound.infinite()  # what was said before T0 is in the log
        if live:
            start, end = bound.cursor_relative(seconds=-LIVE_WINDOW_S), bound.cursor_relative()
        self._axis = rrb.TimeAxis(link="Independent", view_range=rr.TimeRange(start=start, end=end))

    def lines(self, name: str, *entities: str, legend: bool = False) -> rrb.TimeSeriesView:
        """Scalars of some entities; a legend where the title does not say which series it is."""
        return rrb.TimeSeriesView(
            origin="/",
            contents=[f"+ {entity}" for entity in entities],
            name=name,
            axis_x=self._axis,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        )

    def states(self, name: str, entity: str) -> rrb.StateTimelineView:
        """A state machine as a coloured lane."""
        return rrb.StateTimelineView(origin="/", contents=[f"+ {entity}"], name=name, time_view=self._axis)
