"""Messages to bytes and back, with everything refused counted: what both buses share.

On the wire a message is its msgpack encoding and, after that, the CRC-32 of it. Zenoh (1.10) sends a
message that does not fit into the rest of a batch in fragments; when it gives up a link in the middle of one,
because a reader stalled or the session closes, the receiver may get the beginning of one message with the
end of another. Measured: 8 of 8 readers that stalled for over a second under a full queue, and 1 of these
messages decoded, as a batch of steps that never were.
"""

from __future__ import annotations

import logging
import threading
import zlib
from collections import Counter
from collections.abc import Callable
from operator import attrgetter
from typing import Any, Generic

import msgspec

from rtcore.channels import Channel, MessageT
from rtcore.lifecycle import RateLimited
from rtcore.messages import Action, Message, Spec, Stats, Step, StepBatch

LOG_PERIOD_S = 10.0  # a flood of bad messages writes one line per channel and period

CRC_BYTES = 4

# Whom a message says it is of, where its key says so too; None: it names nobody.
_NAMED: dict[type[Message], Callable[[Any], str | None]] = {
    Spec: attrgetter("env"),
    Step: attrgetter("env"),
    StepBatch: lambda batch: batch.steps[0].env if batch.steps else None,  # all of one: `check_batch`
    Action: attrgetter("env"),
    Stats: attrgetter("process"),
}

_FORBIDDEN_IN_NAME = frozenset("/*$#?@")  # they mean something in a key


def key_for(channel: Channel[MessageT], name: str, *, wildcard: bool) -> str:
    """The channel's key for `name`, below the run's namespace.

    Args:
        channel: the channel.
        name: of an environment or process; `*` for all, if `wildcard`; empty on a channel without names.
        wildcard: whether the caller reads and so may ask for all.

    Raises:
        ValueError: the name does not fit the channel.
    """
    if "{name}" not in channel.key:
        if name:
            raise ValueError(f"name = {name!r}: channel {channel.name} has none, so it must be empty")
    elif not (wildcard and name == "*"):
        check_name(name)
    return channel.key_for(name)


def check_name(name: str) -> None:
    """Raise ValueError unless `name` can stand in a key."""
    if not name or _FORBIDDEN_IN_NAME.intersection(name):
        raise ValueError(f"name = {name!r}: must be non-empty and without any of / * $ # ? @")


def name_in(key: str) -> str:
    """The environment or process that a key below the run's namespace is of; empty if it is of none."""
    parts = key.split("/")
    return parts[1] if len(parts) > 1 else ""


class Rejections:
    """Counts refused messages per channel and logs them at a limited rate. Usable from any thread."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._loggers: dict[str, RateLimited] = {}

    def count(self, channel: str, reason: object) -> None:
        """Count one refused message on the channel called `channel`."""
        with self._lock:
            self._counts[channel] += 1
            logger = self._loggers.get(channel)
            if logger is None:
                logger = RateLimited(logging.getLogger(__name__), LOG_PERIOD_S, now_ns=self._now_ns)
                self._loggers[channel] = logger
        logger.warning("channel %s: message rejected: %s", channel, reason)

    def counts(self) -> dict[str, int]:
        """Refused so far, per channel."""
        with self._lock:
            return dict(self._counts)


def seal(encoded: bytes) -> bytes:
    """Append the CRC-32, little-endian."""
    return encoded + zlib.crc32(encoded).to_bytes(CRC_BYTES, "little")


class Codec(Generic[MessageT]):
    """Encodes and decodes one channel's messages within its limits. Usable from any thread."""

    def __init__(self, channel: Channel[MessageT], rejections: Rejections, name: str = "") -> None:
        """`name`: the environment or process whose key is read; empty or `*`: `decode` is told, or none."""
        self._channel = channel
        self._rejections = rejections
        self._name = "" if name == "*" else name
        self._named = _NAMED.get(channel.type, _nobody)
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(channel.type).decode

    def encode(self, message: MessageT) -> bytes:
        """The message as bytes.

        Raises:
            TypeError: not of the channel's type.
            ValueError: larger than the channel allows.
        """
        channel = self._channel
        if type(message) is not channel.type:
            raise TypeError(
                f"channel {channel.name} carries {channel.type.__name__}, not {type(message).__name__}"
            )
        payload = seal(self._encode(message))
        if len(payload) > channel.max_bytes:
            size = f"{len(payload)} bytes"
            raise ValueError(
                f"channel {channel.name}: a message of {size}: at most {channel.max_bytes} allowed"
            )
        return payload

    def fits(self, size: int) -> bool:
        """Whether a received message of `size` bytes is within the limit; counts it if not."""
        if size <= self._channel.max_bytes:
            return True
        self._rejections.count(self._channel.name, f"{size} bytes: at most {self._channel.max_bytes} allowed")
        return False

    def intact(self, payload: bytes) -> bool:
        """Whether the bytes are those that were sent; counts them if not."""
        encoded = memoryview(payload)[:-CRC_BYTES]
        if zlib.crc32(encoded) == int.from_bytes(payload[-CRC_BYTES:], "little") and encoded:
            return True
        self._rejections.count(self._channel.name, f"{len(payload)} bytes with a wrong checksum")
        return False

    def decode(self, payload: bytes, name: str = "") -> MessageT | None:
        """The message, or None, and one more on the count: the bytes are not a valid one, the channel's check
        refuses it, or it names another than the key that it came on, which is that of `name`."""
        if not self.intact(payload):
            return None
        try:
            message = self._decode(memoryview(payload)[:-CRC_BYTES])
            if name or self._name:
                self._compare(self._named(message), name or self._name)
            self._channel.check(message)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            self._rejections.count(self._channel.name, error)
            return None
        return message

    def reject(self, reason: object) -> None:
        """Count a message that was not looked at."""
        self._rejections.count(self._channel.name, reason)

    @staticmethod
    def _compare(said: str | None, name: str) -> None:
        if said is not None and said != name:
            raise ValueError(f"says that it is of {said[:80]!r} on the key of {name!r}")


def _nobody(_message: object) -> None:
    """A message that names nobody."""
