"""What a recording opens with shows what is recorded."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import msgspec
import rerun.blueprint as rrb

from recorder.dashboard import dashboard
from recorder.fleet_dashboard import SIDE_BY_SIDE, fleet_dashboard
from recorder.scene import PointScene
from recorder.styling import FLEET, LOOKS, fleet_colour, fleet_looks
from recorder.telemetry import FORECAST
from tests.recorder.stage import SPEC


def views(container: Any) -> Iterator[Any]:
    """Of a container and all within it."""
    for part in container.contents:
        if isinstance(part, rrb.Container):
            yield from views(part)
        else:
            yield part


def fleet(count: int, *, camera: bool = True, is_speed: bool = True) -> rrb.Blueprint:
    roots = [f"/env{i}" for i in range(count)]
    return fleet_dashboard(SPEC, PointScene.camera if camera else None, roots, drift_is_speed=is_speed)


def entities_of(view: Any) -> list[str]:
    return [entity.removeprefix("+ ") for entity in cast(list[str], view.contents)]


def plotted(**spec: Any) -> dict[str, list[str]]:
    """Entities of each plot, by its title."""
    layout = dashboard(msgspec.structs.replace(SPEC, **spec), None, drift_is_speed=False)
    return {
        str(view.name): [entity.removeprefix("+ ") for entity in cast(list[str], view.contents)]
        for view in views(layout.root_container)
        if isinstance(view, rrb.TimeSeriesView)
    }


def test_a_plot_is_of_what_has_a_look() -> None:
    """So a title cannot go on pointing at a series that was renamed."""
    known = {*LOOKS, FORECAST, "/env/drift", "/learner/loss/**"}
    for title, entities in plotted().items():
        assert entities and set(entities) <= known, title


def test_the_windows_are_drawn_as_steps() -> None:
    assert plotted()["Window, units"] == ["/learner/schedule/update", "/learner/schedule/hold"]
    looks = [LOOKS[entity] for entity in plotted()["Window, units"]]
    assert [look.names for look in looks] == [("update G",), ("hold N",)]
    assert [look.drawing for look in looks] == ["Steps", "Steps"]


def test_a_table_has_no_temperature() -> None:
    assert "Temperature" in plotted()
    assert "Temperature" not in plotted(states=5, actions=2)


def test_a_fleets_plots_have_a_line_for_each_environment() -> None:
    shown = {str(view.name): view for view in views(fleet(3).root_container)}
    for name, entity in {
        "Return per episode": "/env/return",
        "Reward per tick": "/env/reward",
        "Loop, µs (deadline 20,000)": "/agent/loop_us",
        "Missed deadlines": "/agent/missed",
        "Drifting target and speeds reached, m/s": "/env/drift",
    }.items():
        assert entities_of(shown[name]) == [f"/env{i}{entity}" for i in range(3)], name
    assert entities_of(shown["Policy version"]) == [
        "/learner/published_version", *(f"/env{i}/agent/policy_version" for i in range(3))
    ]  # fmt: skip
    assert {"/env0/agent/missed/transport", "/env2/agent/missed/env_late"} <= set(
        entities_of(shown["Causes of misses"])
    )
    alone = {
        str(view.name): view for view in views(dashboard(SPEC, None, drift_is_speed=True).root_container)
    }
    of_learner = {name for name, view in alone.items() if "/learner/" in str(view.contents)}
    assert of_learner <= set(shown)


def test_the_learner_is_in_a_fleets_first_row() -> None:
    first = cast(Any, fleet(4).root_container).contents[0]
    assert {"Learner's phase", "Policy version", "Losses"} <= {str(view.name) for view in views(first)}


def test_every_world_of_a_fleet_has_a_view() -> None:
    for count in (2, SIDE_BY_SIDE, SIDE_BY_SIDE + 1, 16):
        worlds = [view for view in views(fleet(count).root_container) if isinstance(view, rrb.Spatial3DView)]
        assert [(view.origin, view.contents) for view in worlds] == [
            (f"/env{i}/world/follow", f"/env{i}/world/**") for i in range(count)
        ]
    assert not any(
        isinstance(view, rrb.Spatial3DView) for view in views(fleet(2, camera=False).root_container)
    )


def test_a_drift_that_is_no_speed_is_shown_once() -> None:
    shown = {str(view.name): view for view in views(fleet(3, is_speed=False).root_container)}
    assert entities_of(shown["Drift"]) == ["/env0/env/drift", "/env0/env/physics"]


def test_a_target_that_all_have_is_drawn_once() -> None:
    for index in range(3):
        (lines,) = fleet_looks(f"env{index}", index, drift_is_speed=True)["/env/drift"]
        assert cast(Any, lines).visible_series.as_arrow_array().to_pylist() == [index == 0, True]


def test_environments_have_a_colour_each() -> None:
    assert len({fleet_colour(i) for i in range(16)}) == 16
    assert [fleet_colour(i) for i in range(len(FLEET))] == list(FLEET)
    assert all(fleet_colour(i) & 0xFF == 0xFF for i in range(16))
