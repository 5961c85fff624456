"""How the launcher names those it waits for."""

from __future__ import annotations

from launcher.lookout import by_role
from rtcore import cast
from rtcore.channels import PROCESSES
from tests.launcher.ledgers import FLEET


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
