"""A Zenoh session, and publishing and subscribing on the real-time path: what the bus is built on.

Apart from the bus, so that a measurement without it (`tenuto latency`) has exactly its settings.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable

import zenoh
from zenoh import handlers

from rtcore.zenoh_config import RUNTIME


def open_session(settings: dict[str, object]) -> zenoh.Session:
    """Open a session with the settings of `zenoh_config.session_config`. Its threads inherit the caller's
    scheduling and cores.

    Raises:
        zenoh.ZError: Zenoh refuses.
    """
    os.putenv("ZENOH_RUNTIME", RUNTIME)  # Zenoh has no other way to set its threads
    # Silent unless RUST_LOG is set, because it writes to stdout.
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # Zenoh's stub has no return type
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


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
