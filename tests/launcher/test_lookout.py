"""How the launcher names those it waits for, and what a view that cannot be opened costs."""

from __future__ import annotations

from pathlib import Path

from launcher.lookout import Lookout, by_role
from launcher.viewer import Viewer
from launcher.vitals import Vitals
from rtcore import cast
from rtcore.channels import PROCESSES, RECORDER
from rtcore.clock import VirtualClock
from rtcore.config import RecorderConfig
from tests.launcher.ledgers import FLEET, ledger
from tests.launcher.test_screen import screen_of, watched


def test_processes_are_named_in_connect_order() -> None:
    assert by_role(frozenset(PROCESSES)) == list(PROCESSES)
    assert by_role(frozenset({"recorder", "agent_service"})) == ["agent_service", "recorder"]


def test_those_of_a_fleet_are_counted_until_one_is_left() -> None:
    names = frozenset(cast.names(FLEET))
    assert by_role(names) == ["3 env_server", "3 agent_service", "learner", "recorder"]
    assert by_role(names - {"env_server.0", "env_server.2"}) == [
        "env_server.1", "3 agent_service", "learner", "recorder"
    ]  # fmt: skip
    assert by_role(frozenset()) == []


def test_a_view_that_cannot_be_opened_is_said_once(tmp_path: Path) -> None:
    watch, clock = watched(), VirtualClock()
    watch.feed(ledger(RECORDER), 0)
    screen, file, _ = screen_of(watch)
    viewer = Viewer(RecorderConfig(view="web"), tmp_path / "none" / "viewer.out")
    lookout = Lookout(watch, Vitals(8.0), screen, viewer, clock)
    for _ in range(2):
        lookout.look(frozenset())
    said = [line for line in file.getvalue().splitlines() if "view" in line]
    assert said == [f"no view: [Errno 2] No such file or directory: '{tmp_path / 'none' / 'viewer.out'}'"]
