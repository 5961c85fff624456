"""How the bus sends: a Zenoh publisher for each promise that a channel makes."""

from __future__ import annotations

from typing import Generic, Protocol

import zenoh
from zenoh import ext

from rtcore.bus import BusClosedError
from rtcore.channels import Delivery, MessageT
from rtcore.codec import Codec
from rtcore.zenoh_session import realtime_publisher

LOSSLESS_CACHE = 2000  # batches a publisher keeps: 100 s at 20 a second
HEARTBEAT_S = 0.5  # how soon a reader learns that it missed a publisher's last message


class Sender(Protocol):
    """A Zenoh publisher, plain or advanced."""

    def put(self, payload: bytes) -> None:
        """Send bytes."""


class ZenohPublisher(Generic[MessageT]):
    """Sends on one key; see `rtcore.bus.Publisher`."""

    def __init__(self, codec: Codec[MessageT], sender: Sender) -> None:
        self._encode = codec.encode
        self._sender = sender

    def put(self, message: MessageT) -> None:
        """Send."""
        payload = self._encode(message)
        try:
            self._sender.put(payload)
        except zenoh.ZError as error:
            raise BusClosedError(str(error)) from error


def declare_sender(session: zenoh.Session, key: str, delivery: Delivery) -> Sender:
    """What sends on `key` as `delivery` promises, for as long as it is referred to."""
    drop, block = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
    if delivery is Delivery.REALTIME:
        return realtime_publisher(session, key)
    if delivery is Delivery.TELEMETRY:
        return session.declare_publisher(key, congestion_control=drop, priority=zenoh.Priority.DATA)
    if delivery is Delivery.LOSSLESS:
        depth, every_s, on_change_s = LOSSLESS_CACHE, HEARTBEAT_S, None
    else:
        depth, every_s, on_change_s = 1, None, HEARTBEAT_S
    return ext.declare_advanced_publisher(
        session,
        key,
        congestion_control=block,
        priority=zenoh.Priority.DATA_LOW,
        cache=ext.CacheConfig(max_samples=depth),
        publisher_detection=True,
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=every_s, sporadic_heartbeat=on_change_s),
    )
