"""A router: its settings, and what reaches whom through it."""

from __future__ import annotations

import socket
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcore.bus import BusError
from rtcore.channels import ENV_SERVER, LEARNER, LOG, POLICY, RECORDER, STATS
from rtcore.messages import Command, CommandReply
from rtcore.monotonic import MonotonicClock
from rtcore.zenoh_bus import ZenohBus, open_bus, open_bus_by_router
from rtcore.zenoh_config import Endpoints, session_config
from rtcore.zenoh_router import router_config, through_router
from rtcore.zenoh_session import open_router
from tests.rtcore.bus_samples import ENV, batch, collect, eventually, policy, stats

RUN = "r1"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A router's."""
    found = f"tcp/127.0.0.1:{free_port()}"
    with open_router([found]):
        yield found


@pytest.fixture
def peers(endpoint: str) -> Iterator[tuple[ZenohBus, ZenohBus]]:
    """An env server and a learner on unix sockets, both connected to the router besides."""
    with tempfile.TemporaryDirectory(prefix="tn", dir="/tmp") as directory:
        place = Path(directory)
        with (
            open_bus(
                ENV_SERVER, RUN, place, clock=MonotonicClock(), endpoints=Endpoints(connect=(endpoint,))
            ) as env,
            open_bus(
                LEARNER, RUN, place, clock=MonotonicClock(), endpoints=Endpoints(connect=(endpoint,))
            ) as learner,
        ):
            yield env, learner


def test_who_is_elsewhere_hears_everything_once_and_is_heard(
    endpoint: str, peers: tuple[ZenohBus, ZenohBus]
) -> None:
    env, learner = peers
    log, near = env.publisher(LOG, ENV), learner.queue(LOG, ENV)
    for seq in range(5):
        log.put(batch(seq))
    learner.publisher(POLICY).put(policy(version=3))
    env.declare_alive(ENV_SERVER)
    env.serve(ENV_SERVER, lambda command: CommandReply(id=command.id, ok=True, text="here"))
    with open_bus_by_router(RECORDER, RUN, endpoint, clock=MonotonicClock()) as far:
        history, policies = far.queue(LOG, ENV), far.latest(POLICY)
        assert collect(history, 4) == [0, 1, 2, 3, 4]  # sent before it came
        log.put(batch(5))
        assert collect(history, 5) == [5]
        assert eventually(lambda: (received := policies.take()) is not None and received.message.version == 3)
        assert eventually(lambda: ENV_SERVER in far.alive())
        assert far.ask(ENV_SERVER, Command(id="1", verb="status")).text == "here"
        heard = env.queue(STATS, RECORDER)
        speaker = far.publisher(STATS, RECORDER)

        def spoken() -> bool:
            speaker.put(stats(RECORDER))
            return bool(heard.drain())

        assert eventually(spoken)
    assert collect(near, 5) == [0, 1, 2, 3, 4, 5]  # beside the router, each still comes once
    assert learner.rejected().get("log", 0) == 0


def test_a_peer_settings_become_those_of_a_client_with_one_way_out() -> None:
    settings = session_config(RECORDER, RUN, Path("/nowhere"), endpoints=Endpoints(connect=("tls/other:1",)))
    client = through_router(settings, "tcp/host:7447")
    assert client["mode"] == "client"
    assert client["listen"] == {"endpoints": []}
    assert client["connect"]["endpoints"] == ["tcp/host:7447"]  # type: ignore[index]
    assert client["connect"]["timeout_ms"] == -1  # type: ignore[index]  # it may come before the router
    assert client["transport"]["link"]["protocols"] == ["tcp"]  # type: ignore[index]
    assert settings["mode"] == "peer"  # and are left as they were
    assert client["namespace"] == settings["namespace"]


def test_what_is_no_endpoint_is_refused() -> None:
    with pytest.raises(ValueError, match="tcp/host:port"):
        router_config(["7447"])
    with pytest.raises(ValueError, match="tcp/host:port"):
        through_router(session_config(RECORDER, RUN, Path("/nowhere")), "host")


def test_a_port_in_use_is_refused(endpoint: str) -> None:
    with pytest.raises(BusError, match="no router can listen"):
        open_router([endpoint])


def test_no_thread_stays_behind(endpoint: str) -> None:
    before = threading.active_count()
    with open_bus_by_router(RECORDER, RUN, endpoint, clock=MonotonicClock()):
        pass
    assert eventually(lambda: threading.active_count() <= before)
