"""Settings of a Zenoh router, and of a session that reaches a run through one.

A router relays between its clients and the peers that are connected to it, not from peer to peer. So the
processes on one machine are the peers that they always are, and connect to the router besides; whoever is
elsewhere is its client. A client restarted is back after 0.08 s; a router restarted takes its clients' links
along for as long as it is away and half a second, and the peers notice nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

from rtcore.zenoh_config import BLOCK_US, LEASE_MS, MAX_MESSAGE_BYTES


def router_config(listen: Sequence[str]) -> dict[str, object]:
    """The configuration of a router's session.

    Args:
        listen: endpoints, such as `tcp/0.0.0.0:7447`.

    Raises:
        ValueError: one is none.
    """
    return {
        "mode": "router",
        "metadata": {"name": "router"},
        "listen": {"endpoints": list(listen), "timeout_ms": 0, "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "protocols": sorted({_protocol(endpoint) for endpoint in listen}),
                "tx": {
                    "lease": LEASE_MS,
                    "keep_alive": 4,
                    "queue": {"congestion_control": {"block": {"wait_before_close": BLOCK_US}}},
                },
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }


def through_router(settings: dict[str, object], endpoint: str) -> dict[str, object]:
    """A peer's settings (`zenoh_config.session_config`), made those of a client of the router at `endpoint`,
    which has no other link.

    Raises:
        ValueError: it is no endpoint.
    """
    connect, transport = settings["connect"], settings["transport"]
    assert isinstance(connect, dict) and isinstance(transport, dict)
    link = transport["link"] | {"protocols": [_protocol(endpoint)]}
    return settings | {
        "mode": "client",
        "listen": {"endpoints": []},
        "connect": connect | {"endpoints": [endpoint]},
        "transport": transport | {"link": link},
    }


def _protocol(endpoint: str) -> str:
    protocol, slash, _ = endpoint.partition("/")
    if not slash:
        raise ValueError(f"endpoint {endpoint!r}: must be like tcp/host:port")
    return protocol
