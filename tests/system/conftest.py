"""Runs of real processes mostly wait: a group of them is played at once, when the first one is wanted."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

# Test modules; each has `play(home)`, which returns what its tests look at. Together those of a group keep
# two cores busy for less than three quarters of the time. Not among them: what judges single deadlines.
GROUPS = (
    ("test_chaos", "test_schedule", "test_tables"),
    ("test_killed", "test_rogues", "test_two_hosts"),
)


@pytest.fixture(scope="session")
def played(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """What a module's `play` has returned; raises what it raised."""
    here = Path(__file__).parent  # other folders have a test_killed, too
    modules = {
        item.path.stem: item.module
        for item in request.session.items
        if isinstance(item, pytest.Function) and item.path.parent == here
    }
    stories: dict[str, Future[Any]] = {}

    def story(name: str) -> Any:
        if name not in stories:
            wanted = [one for group in GROUPS if name in group for one in group if one in modules]
            with ThreadPoolExecutor(len(wanted)) as pool:  # leaves when all have ended
                for one in wanted:
                    stories[one] = pool.submit(modules[one].play, tmp_path_factory.mktemp(one[5:]))
        return stories[name].result()

    return story
