"""How a service talks: the interface that the Zenoh bus and the in-memory bus both keep.

Readers choose: `latest` (the newest only, nothing piles up) or `queue` (bounded, counts what it
drops). A message that does not decode, or is too large, is counted, logged at a limited rate and
dropped; it never reaches a service and never stops a loop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from rtcore.channels import Channel, MessageT
from rtcore.messages import Command, CommandReply

T_co = TypeVar("T_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)


@dataclass(frozen=True, slots=True)
class Received(Generic[T_co]):
    """A message and the monotonic instant at which it reached this process."""

    message: T_co
    received_ns: int


class Publisher(Protocol[T_contra]):
    """Sends on one key."""

    def put(self, message: T_contra) -> None:
        """Send. On a LOSSLESS or RETAINED channel this may block for seconds when a reader stalls
        (measured with Zenoh 1.10), so call it from a background thread; REALTIME and TELEMETRY
        never wait.

        Raises:
            TypeError: the message is not of the channel's type.
            ValueError: the encoded message exceeds the channel's `max_bytes`.
            BusClosedError: the bus is closed.
        """


class LatestReader(Protocol[T_co]):
    """Holds the newest message only."""

    def take(self) -> Received[T_co] | None:
        """The newest message if it was not taken before, else None. Never waits."""

    def wait(self, timeout_s: float) -> Received[T_co] | None:
        """Like `take`, but waits up to `timeout_s` seconds for one to arrive. A signal handler runs
        during the wait, which then goes on: keep the timeout short where a signal must end a loop."""


class QueueReader(Protocol[MessageT]):
    """Holds every message in order, up to a capacity; beyond it the oldest is dropped and counted."""

    @property
    def dropped(self) -> int:
        """Messages lost because the queue was full."""

    def drain(self) -> list[Received[MessageT]]:
        """All waiting messages, oldest first. Never waits."""

    def wait(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` seconds until something can be drained; say whether it can.
        What came may still be rejected, so `drain` can be empty after True."""


class Bus(Protocol):
    """One process's connection to all the others. Usable from any thread.

    A process also hears itself: its own readers get what it publishes. After `close`, `put` and every
    method but `reject`, `rejected` and `close` raise BusClosedError; readers give what they still hold.
    """

    def publisher(self, channel: Channel[MessageT], name: str = "") -> Publisher[MessageT]:
        """A publisher on the channel's key for environment or process `name`.

        What a LOSSLESS (the newest 2000) or RETAINED (the last) publisher put is there for late
        readers for as long as this bus is open.
        """

    def latest(self, channel: Channel[MessageT], name: str = "") -> LatestReader[MessageT]:
        """A reader of the newest message. `name` may be `*`. A RETAINED channel first gives its last."""

    def attend(
        self, channel: Channel[MessageT], name: str, answer: Callable[[Received[MessageT]], None]
    ) -> None:
        """Call `answer` with each message of a REALTIME channel on the thread that receives it, until this
        bus closes: for what cannot wait until another thread wakes. It must be quick and may `put` on
        REALTIME channels, but nothing else of the bus; it must not raise."""

    def queue(
        self, channel: Channel[MessageT], name: str = "", *, capacity: int = 10_000
    ) -> QueueReader[MessageT]:
        """A reader of every message. `name` may be `*`. LOSSLESS and RETAINED channels first give what
        their publishers still hold; LOSSLESS keeps each publisher's order (after a reconnection,
        de-duplicate by content)."""

    def serve(self, name: str, handler: Callable[[Command], CommandReply]) -> None:
        """Answer commands to process `name`. The handler runs on a thread of the bus and must return at
        once. If it raises, the reply says so with ok=False. A repeated id gets the first reply again."""

    def ask(self, name: str, command: Command, timeout_s: float = 1.0, tries: int = 3) -> CommandReply:
        """Send a command and wait for the reply, up to `timeout_s` seconds in each of `tries`.

        Raises:
            NoAnswerError: nobody answered in time; sooner where nobody is there to answer.
        """

    def declare_alive(self, name: str) -> None:
        """Let the others see that process `name` is connected, until this bus closes."""

    def alive(self) -> frozenset[str]:
        """Names of the processes that are connected now (this one included, once declared)."""

    def reject(self, channel: Channel[MessageT], reason: object) -> None:
        """Count a message that its reader refuses though it is valid by itself; logged at a limited rate."""

    def rejected(self) -> dict[str, int]:
        """Messages refused so far, per channel name."""

    def close(self) -> None:
        """Leave, within two seconds. A second close does nothing."""


class BusError(Exception):
    """The bus cannot be opened."""


class BusClosedError(BusError):
    """The bus was closed before this call, or during it."""


class NoAnswerError(Exception):
    """A command got no reply within its time and tries."""
