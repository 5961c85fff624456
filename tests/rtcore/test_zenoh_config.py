"""The settings of a session."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcore.channels import AGENT, ENV_SERVER, LEARNER, RECORDER
from rtcore.zenoh_config import session_config


def test_settings_that_no_session_can_be_made_of() -> None:
    with pytest.raises(ValueError, match=r"role = 'actor': must be one of env_server, agent_service"):
        session_config("actor", "run", Path("/tmp"))
    with pytest.raises(ValueError, match="run_name is empty"):
        session_config(AGENT, "", Path("/tmp"))
    with pytest.raises(ValueError, match=r"has 12\d bytes: at most 107"):
        session_config(AGENT, "run", Path("/tmp") / ("d" * 100))
    with pytest.raises(ValueError, match="without any of"):
        session_config(AGENT, "run", Path("/tmp/a#b"))
    with pytest.raises(ValueError, match="endpoint 'localhost:7447': must be like tcp/host:port"):
        session_config(AGENT, "run", Path("/tmp"), connect=["localhost:7447"])


def test_each_role_connects_to_the_earlier_ones() -> None:
    def endpoints(role: str, key: str) -> list[str]:
        section = session_config(role, "run", Path("/s"))[key]
        assert isinstance(section, dict)
        return [endpoint.removeprefix("unixsock-stream//s/") for endpoint in section["endpoints"]]

    roles = (ENV_SERVER, AGENT, LEARNER, RECORDER, "client")
    assert [endpoints(role, "listen") for role in roles] == [
        ["env_server.sock"],
        ["agent_service.sock"],
        ["learner.sock"],
        ["recorder.sock"],
        [],
    ]
    assert [len(endpoints(role, "connect")) for role in roles] == [0, 1, 2, 3, 4]
    assert endpoints(LEARNER, "connect") == ["env_server.sock", "agent_service.sock"]


def test_protocols_are_those_of_the_endpoints() -> None:
    config = session_config(
        AGENT, "a b", Path("/s"), connect=["tcp/h:1", "tls/h:2"], listen=["tcp/0.0.0.0:3"]
    )
    transport = config["transport"]
    assert isinstance(transport, dict)
    assert transport["link"]["protocols"] == ["tcp", "tls", "unixsock-stream"]
    assert config["namespace"] == "tenuto/a%20b"
