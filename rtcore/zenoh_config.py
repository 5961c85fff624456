"""The settings of a Zenoh session, as data: one run's peers on one machine, and any further endpoints.

Peers without a router. Every process offers a unix socket in the run's directory and connects to the
processes that come before it in connect order (`rtcore.cast`), so that each pair has one link whatever
the order in which they start. Where links are secured, a port on the loopback with mutual TLS takes the
socket's place, and nothing else is spoken. Each constant below carries the measurement (Zenoh 1.10.2, two
cores) that set it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from rtcore import channels
from rtcore.config import ConfigError
from rtcore.signing import Identity
from rtcore.zenoh_access import access_control
from rtcore.zenoh_ports import HOST

CLIENT = "client"  # the launcher and its commands: offers nothing, connects to all
SOCKET_PATH_LIMIT = 107  # bytes of a unix socket's path, by the system

# Worker threads. A reader that stalls while it is sent a history blocks one receiving worker of the
# publisher's process. With 1 such worker, every healthy replay of 2000 batches delayed the actions by 38
# ticks of 2 ms and a stopped reader by 960; with 2, two stopped readers by 749; with 4, by 1. The round
# trip is the same with 1, 2 and 4 (140 to 160 us at 500 Hz). Elsewhere one worker is enough; `net` also
# reconnects, and a heartbeat may block one of its workers. Threads of their own for each: with what accepts
# on the receiving threads, which saves a wake-up of 10 to 20 us, a reader given up came back to nothing in 1
# of 4 tries; with `tx` or `net` there, late readers got no history.
RUNTIME = (
    "(rx:(worker_threads:4),tx:(worker_threads:1),app:(worker_threads:1),"
    "net:(worker_threads:2),acc:(worker_threads:1))"
)

# A process is taken for dead after so long without a sign: longer than any hold of the interpreter lock
# (an import of torch), which keeps the callbacks waiting.
LEASE_MS = 3000
# A put on a LOSSLESS or RETAINED channel waits for a stalled reader so long, then that reader's link is
# closed, and it recovers from the history once it runs again. It also bounds `close`: with one stopped reader
# and a put waiting for it 1.0 s, with three 2.0 s; with the default of 5 s, 4.8 s with one.
BLOCK_US = 500_000
# Whoever is back after a kill -9 is found again within 0.2 s. An agent with no file at all then acts on the
# newest policy 0.37 s after its start; it was 0.47 s with tries up to 250 ms apart. A try costs nothing
# measurable.
RETRY_FIRST_MS, RETRY_MOST_MS = 50, 100
OPEN_DELAY_MS = 300  # `open` waits so long at most for processes that are not there yet
MAX_MESSAGE_BYTES = 64 << 20


def socket_path(socket_dir: Path, process: str) -> Path:
    """Where the process of that name listens."""
    return socket_dir / f"{process}.sock"


@dataclass(frozen=True)
class Endpoints:
    """Where a session goes beyond its run's own sockets; each like `tcp/host:7447`."""

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()


NO_MORE = Endpoints()


@dataclass(frozen=True)
class Security:
    """What a session needs for secured links."""

    identity: Identity
    ports: Mapping[str, int]  # of all processes, on this machine's loopback


def session_config(
    process: str,
    run_name: str,
    socket_dir: Path,
    *,
    peers: Sequence[str] = channels.PROCESSES,
    endpoints: Endpoints = NO_MORE,
    security: Security | None = None,
) -> dict[str, object]:
    """The configuration of one process's session, as Zenoh reads it.

    Args:
        process: one of `peers`, or `CLIENT`.
        run_name: separates the keys of runs that meet on a network.
        socket_dir: the run's directory for sockets.
        peers: the names of all processes of the run, in connect order (`rtcore.cast.names`).
        endpoints: further ones.
        security: for secured links; None: unix sockets, and endpoints as they are.

    Raises:
        ValueError: an argument that no session can be made of.
    """
    if process not in (*peers, CLIENT):
        raise ValueError(f"process = {process!r}: must be one of {', '.join((*peers, CLIENT))}")
    if not run_name:
        raise ValueError("run_name is empty")
    own, earlier = _own_and_earlier(process, tuple(peers))
    namespace = f"tenuto/{quote(run_name, safe='')}"
    connect, listen = endpoints.connect, endpoints.listen
    protocols = _protocols((*connect, *listen), security)
    secured = {} if security is None else {"access_control": access_control(namespace)}
    return {
        "mode": "peer",
        "namespace": namespace,
        "metadata": {"name": process},
        "listen": {
            "endpoints": [*(_endpoint(socket_dir, name, security) for name in own), *listen],
            "timeout_ms": 0,
            "exit_on_failure": True,  # a socket in use: the process runs already
        },
        "connect": _connecting([*(_endpoint(socket_dir, name, security) for name in earlier), *connect]),
        # Without connect_scouted a restarted reader asks for history before it is connected, and gets none.
        "open": {"return_conditions": {"connect_scouted": True, "declares": True}},
        "scouting": {
            "delay": OPEN_DELAY_MS,
            "multicast": {"enabled": False},
            "gossip": {"enabled": False},
        },
        "queries_default_timeout": 2000,
        "transport": _transport(protocols, security),
    } | secured


def _connecting(endpoints: list[str]) -> dict[str, object]:
    return {
        "endpoints": endpoints,
        "timeout_ms": -1,  # retry for ever; 0 would mean once
        "exit_on_failure": False,
        "retry": {
            "period_init_ms": RETRY_FIRST_MS,
            "period_max_ms": RETRY_MOST_MS,
            "period_increase_factor": 2,
        },
    }


def require_tls(endpoints: Sequence[str]) -> None:
    """Refuse endpoints that secured links may not have.

    Raises:
        ConfigError: one is not by TLS.
    """
    for endpoint in endpoints:
        if not endpoint.startswith("tls/"):
            raise ConfigError("endpoint", endpoint, "must be like tls/host:port, as link.secure is given")


def _transport(protocols: list[str], security: Security | None) -> dict[str, object]:
    return {
        # Chunks in shared memory are dropped silently when a receiver stalls for more than 0.1 s.
        "shared_memory": {"enabled": False},
        "unicast": {"open_timeout": 3000, "accept_timeout": 3000},
        "link": {
            "protocols": protocols,
            "tx": {
                "lease": LEASE_MS,
                "keep_alive": 4,
                "queue": {"congestion_control": {"block": {"wait_before_close": BLOCK_US}}},
            },
            "rx": {"max_message_size": MAX_MESSAGE_BYTES},
        }
        | ({} if security is None else {"tls": _tls(security.identity)}),
    }


def _tls(identity: Identity) -> dict[str, object]:
    """Both ends show a certificate of the same authority; who connects also checks the host's name in it."""
    certificate, key = str(identity.certificate), str(identity.key)
    return {
        "root_ca_certificate": str(identity.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "connect_certificate": certificate,
        "connect_private_key": key,
    }


def _own_and_earlier(process: str, peers: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if process == CLIENT:
        return (), peers
    return (process,), peers[: peers.index(process)]


def _endpoint(socket_dir: Path, process: str, security: Security | None) -> str:
    if security is not None:
        return f"tls/{HOST}:{security.ports[process]}"
    path = socket_path(socket_dir, process)
    _check_socket_path(path)
    return f"unixsock-stream/{path}"


def _check_socket_path(path: Path) -> None:
    text = str(path)
    if len(text.encode()) > SOCKET_PATH_LIMIT:
        raise ValueError(f"socket path {text} has {len(text.encode())} bytes: at most {SOCKET_PATH_LIMIT}")
    if set("?#;") & set(text):
        raise ValueError(f"socket path {text}: must be without any of ? # ;")


def _protocols(endpoints: Sequence[str], security: Security | None) -> list[str]:
    for endpoint in endpoints:
        if "/" not in endpoint:
            raise ValueError(f"endpoint {endpoint!r}: must be like tcp/host:port")
    if security is not None:
        require_tls(endpoints)
        return ["tls"]
    return sorted({"unixsock-stream", *(endpoint.partition("/")[0] for endpoint in endpoints)})
