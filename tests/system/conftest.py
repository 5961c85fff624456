"""Runs of real processes mostly wait: a group of them is played at once, when the first one is wanted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

# Test modules; each has `play(home)`, which returns what its tests look at, or such functions by the name of
# the fixture that waits for it, in `STORIES`. The lanes of a group are played at once, what is in a lane one
# after the other. Together they keep two cores busy for some three quarters of the time. Not among them: what
# judges single deadlines.
GROUPS = (
    (
        ("test_chaos",),
        ("test_schedule", "test_processes.twice_interrupted_run"),
        ("test_tables", "test_restart"),
    ),
    (("test_killed",), ("test_rogues", "test_compose"), ("test_two_hosts",)),
    (
        ("test_processes.env_last", "test_processes.held_run"),
        # The last, when the others have hardly anything to do: its end has a limit of seconds.
        ("test_processes.env_first", "test_processes.whole_run", "test_processes.interrupted_run"),
    ),
)


@pytest.fixture(scope="session")
def played(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """What a module's `play`, or one of its stories, has returned; raises what it raised."""
    wanted = dict(plays(request.session.items))
    stories: dict[str, Future[Any]] = {}

    def story(name: str) -> Any:
        if name not in stories:
            group = next(group for group in GROUPS if any(name in lane for lane in group))
            with ExitStack() as lanes:  # leaves when all have ended
                for lane in group:
                    pool = lanes.enter_context(ThreadPoolExecutor(1))
                    for one in lane:
                        if one in wanted:
                            home = tmp_path_factory.mktemp(one.removeprefix("test_"))
                            stories[one] = pool.submit(wanted[one], home)
        return stories[name].result()

    return story


def plays(items: Sequence[pytest.Item]) -> Iterator[tuple[str, Callable[[Path], Any]]]:
    """What the tests of this session want to be played, by its name in `GROUPS`."""
    for item in items:  # other folders have a test_killed, too
        if isinstance(item, pytest.Function) and item.path.parent == Path(__file__).parent:
            if hasattr(item.module, "play"):
                yield item.path.stem, item.module.play
            for name, play in getattr(item.module, "STORIES", {}).items():
                if name in item.fixturenames:
                    yield f"{item.path.stem}.{name}", play
