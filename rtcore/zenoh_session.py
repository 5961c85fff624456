"""A Zenoh session, and publishing and subscribing on the real-time path: what the bus is built on.

Apart from the bus, so that a measurement without it (`tenuto latency`) has exactly its settings.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress

import zenoh
from zenoh import handlers

from rtcore.bus import BusError
from rtcore.zenoh_config import RUNTIME
from rtcore.zenoh_router import router_config

CLOSE_LIMIT_S = 2.0
CLOSING = "closing"  # name of the thread


def open_session(settings: dict[str, object], log_filter: str = "") -> zenoh.Session:
    """Open a session with the settings of `zenoh_config.session_config`. Its threads inherit the caller's
    scheduling and cores. `log_filter` is what Zenoh writes to standard output; empty: nothing.

    Raises:
        zenoh.ZError: Zenoh refuses.
    """
    os.putenv("ZENOH_RUNTIME", RUNTIME)  # Zenoh has no other way to set its threads
    # It writes to stdout. So it is silent unless RUST_LOG is set or, on secured links, somebody reads it.
    if log_filter:
        zenoh.init_log_from_env_or(log_filter)
    else:
        zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # Zenoh's stub has no return type
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


def close_session(session: zenoh.Session) -> None:
    """Close a session; give up after CLOSE_LIMIT_S.

    A TLS link to a peer that reads nothing cannot be closed: Zenoh (1.10) tries for 10 s and fails. Over unix
    sockets it takes milliseconds. What is left of the session ends with the process, which must be ended by
    `leave` then.
    """
    closing = threading.Thread(target=_close, args=(session,), name=CLOSING, daemon=True)
    closing.start()
    closing.join(CLOSE_LIMIT_S)


def leave(code: int) -> int:
    """Return `code`, or, if a session was given up on closing, end the process with it at once: a thread that
    comes back from Zenoh while the interpreter ends would abort it.
    """
    if any(thread.name == CLOSING for thread in threading.enumerate()):
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)
    return code


def _close(session: zenoh.Session) -> None:
    with suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub has no return type


def open_router(listen: Sequence[str]) -> zenoh.Session:
    """Open a session that only relays; see `zenoh_router`. It does so until it is closed.

    Raises:
        ValueError: an endpoint is none.
        BusError: Zenoh refuses, as when somebody listens there already.
    """
    try:
        return open_session(router_config(listen))
    except zenoh.ZError as error:
        raise BusError(f"no router can listen on {', '.join(listen)}: {error}") from error


def realtime_publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """A publisher that never waits: the newest counts, and is dropped where the way is blocked."""
    return session.declare_publisher(
        key,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
    )


def realtime_subscriber(
    session: zenoh.Session, key: str, on_sample: Callable[[zenoh.Sample], None]
) -> zenoh.Subscriber[None]:
    """Call `on_sample` on Zenoh's own receiving thread, for as long as the subscriber is referred to."""
    return session.declare_subscriber(key, handlers.Callback(on_sample, indirect=False))
