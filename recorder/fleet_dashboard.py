"""What a viewer opens with when a run has several environments: the learner first, then all of them together.

The top row is the learner's, which there is one of. Below, what the environments do shares views, one line
each in the colour that it has everywhere; their worlds stand side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rerun.blueprint as rrb

from recorder.dashboard import Plots, learner_plots, log_view, page, run_card_view, world_view
from recorder.scene import Camera
from recorder.ticks import MISSED, PHYSICS
from rtcore.messages import CAUSES, Spec

SIDE_BY_SIDE = 4  # worlds at most; of more, each is a tab
NAMED = 8  # lines at most that a legend names: more would cover the plot


def fleet_dashboard(
    spec: Spec, camera: Camera | None, roots: Sequence[str], *, drift_is_speed: bool, live: bool = False
) -> rrb.Blueprint:
    """The layout.

    Args:
        spec: of any of the environments.
        camera: of the 3-D views; None: no 3-D.
        roots: below which each environment's entities lie.
        drift_is_speed: whether `/env/drift` is a target speed.
        live: follow the end of a running stream instead of showing everything.
    """
    fleet = _Fleet(Plots(live), roots)
    worlds = [_worlds(spec, camera, roots)] if camera is not None else []
    rows = [
        fleet.learner(spec),
        [
            *worlds,
            fleet.lines("Return per episode", "/env/return"),
            fleet.lines("Reward per tick", "/env/reward"),
        ],
        [
            rrb.Tabs(log_view(), run_card_view()),
            fleet.drift(drift_is_speed),
            fleet.timing(spec),
            fleet.misses(),
        ],
    ]
    return page(rrb.Vertical(*(rrb.Horizontal(*row) for row in rows), row_shares=[2, 3, 2]))


def _worlds(spec: Spec, camera: Camera, roots: Sequence[str]) -> Any:
    views = [world_view(f"{root[1:]}: {spec.env_id}", camera, root) for root in roots]
    return rrb.Grid(*views, grid_columns=2) if len(views) <= SIDE_BY_SIDE else rrb.Tabs(*views)


class _Fleet:
    """Makes views of what all environments have."""

    def __init__(self, plots: Plots, roots: Sequence[str]) -> None:
        self._plots = plots
        self._roots = roots

    def lines(self, name: str, *entities: str) -> rrb.TimeSeriesView:
        """Scalars of some entities of each environment."""
        return self._plots.lines(name, *self._below(*entities), legend=len(self._roots) <= NAMED)

    def learner(self, spec: Spec) -> list[Any]:
        """What there is one of."""
        acting = self._below("/agent/policy_version")
        return [
            self._plots.states("Learner's phase", "/learner/phase"),
            self._plots.lines(
                "Policy version", "/learner/published_version", *acting, legend=len(self._roots) <= NAMED
            ),
            rrb.Tabs(*learner_plots(self._plots, spec)),
        ]

    def drift(self, is_speed: bool) -> Any:
        """The drift, which is the same for all: without a speed beside it, that of the first is enough."""
        if is_speed:
            return self.lines("Drifting target and speeds reached, m/s", "/env/drift")
        first = self._roots[0]
        return self._plots.lines("Drift", f"{first}/env/drift", f"{first}{PHYSICS}", legend=True)

    def timing(self, spec: Spec) -> Any:
        """Latencies, one kind at a time."""
        deadline = f"deadline {spec.tick_ns / 1e3:,.0f}"
        return rrb.Tabs(
            self.lines(f"Loop, µs ({deadline})", "/agent/loop_us"),
            self.lines("Agent's reaction, µs", "/agent/reaction_us"),
            self.lines("Pacing error, µs", "/env/pacing_us"),
        )

    def misses(self) -> Any:
        """Missed deadlines, and why."""
        causes = self._below(*(f"{MISSED}/{cause}" for cause in CAUSES))
        return rrb.Tabs(
            self.lines("Missed deadlines", MISSED),
            self._plots.lines("Causes of misses", *causes, legend=True),
        )

    def _below(self, *entities: str) -> list[str]:
        return [root + entity for entity in entities for root in self._roots]
