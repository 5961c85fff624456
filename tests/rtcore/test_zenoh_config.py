"""The settings of a session."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rtcore.channels import AGENT, ENV_SERVER, LEARNER, RECORDER
from rtcore.config import ConfigError
from rtcore.signing import Identity
from rtcore.zenoh_access import access_control
from rtcore.zenoh_config import Endpoints, Security, session_config

SECURITY = Security(
    Identity("learner", Path("/k/cert.pem"), Path("/k/key.pem"), Path("/k/ca.pem")),
    {ENV_SERVER: 1, AGENT: 2, LEARNER: 3, RECORDER: 4},
)


def test_settings_that_no_session_can_be_made_of() -> None:
    with pytest.raises(ValueError, match=r"process = 'actor': must be one of env_server, agent_service"):
        session_config("actor", "run", Path("/tmp"))
    with pytest.raises(ValueError, match="run_name is empty"):
        session_config(AGENT, "", Path("/tmp"))
    with pytest.raises(ValueError, match=r"has 12\d bytes: at most 107"):
        session_config(AGENT, "run", Path("/tmp") / ("d" * 100))
    with pytest.raises(ValueError, match="without any of"):
        session_config(AGENT, "run", Path("/tmp/a#b"))
    with pytest.raises(ValueError, match="endpoint 'localhost:7447': must be like tcp/host:port"):
        session_config(AGENT, "run", Path("/tmp"), endpoints=Endpoints(connect=("localhost:7447",)))


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
        AGENT, "a b", Path("/s"), endpoints=Endpoints(("tcp/h:1", "tls/h:2"), ("tcp/0.0.0.0:3",))
    )
    transport = config["transport"]
    assert isinstance(transport, dict)
    assert transport["link"]["protocols"] == ["tcp", "tls", "unixsock-stream"]
    assert config["namespace"] == "tenuto/a%20b"


def test_secured_links_are_tls_alone() -> None:
    config: Any = session_config(
        LEARNER, "run", Path("/s"), endpoints=Endpoints(("tls/h:9",), ("tls/0.0.0.0:8",)), security=SECURITY
    )
    assert config["listen"]["endpoints"] == ["tls/127.0.0.1:3", "tls/0.0.0.0:8"]
    assert config["connect"]["endpoints"] == ["tls/127.0.0.1:1", "tls/127.0.0.1:2", "tls/h:9"]
    link = config["transport"]["link"]
    assert link["protocols"] == ["tls"]
    assert link["tls"]["enable_mtls"] and link["tls"]["verify_name_on_connect"]
    assert {name: path for name, path in link["tls"].items() if isinstance(path, str)} == {
        "root_ca_certificate": "/k/ca.pem",
        "listen_certificate": "/k/cert.pem",
        "listen_private_key": "/k/key.pem",
        "connect_certificate": "/k/cert.pem",
        "connect_private_key": "/k/key.pem",
    }
    assert config["access_control"] == access_control("tenuto/run")


@pytest.mark.parametrize("endpoint", ["tcp/h:1", "unixsock-stream//tmp/x", "quic/h:1"])
def test_no_other_endpoint_beside_secured_ones(endpoint: str) -> None:
    for where in ("connect", "listen"):
        with pytest.raises(ConfigError, match=rf"^endpoint = '{endpoint}': must be like tls/host:port"):
            session_config(
                LEARNER, "run", Path("/s"), security=SECURITY, endpoints=Endpoints(**{where: (endpoint,)})
            )
