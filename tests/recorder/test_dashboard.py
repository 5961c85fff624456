"""What a recording opens with shows what is recorded."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import msgspec
import rerun.blueprint as rrb

from recorder.dashboard import dashboard
from recorder.styling import LOOKS
from recorder.telemetry import FORECAST
from tests.recorder.stage import SPEC


def views(container: Any) -> Iterator[Any]:
    """Of a container and all within it."""
    for part in container.contents:
        if isinstance(part, rrb.Container):
            yield from views(part)
        else:
            yield part


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
