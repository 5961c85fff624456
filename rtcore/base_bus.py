"""What the two buses have in common: readers, the count of refused messages, and the end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rtcore.bus import BusClosedError, LatestReader, QueueReader, Received
from rtcore.channels import Channel, Delivery, MessageT
from rtcore.clock import Clock
from rtcore.codec import Codec, Rejections, key_for
from rtcore.inbox import Attendant, Bell, Inbox, LatestInbox, QueueInbox


class BaseBus(ABC):
    """The part of `rtcore.bus.Bus` that does not depend on the transport."""

    def __init__(self, owner: str, clock: Clock) -> None:
        self._owner = owner  # the process, for error texts
        self._clock = clock
        self._rejections = Rejections(clock.now_ns)
        self._closed = False

    def latest(self, channel: Channel[MessageT], name: str = "") -> LatestReader[MessageT]:
        """A reader of the newest message; see `rtcore.bus.Bus.latest`."""
        self.check_open()
        codec = Codec(channel, self._rejections, name)
        inbox = LatestInbox(codec, self._bell(), self._clock.now_ns)
        retained = channel.delivery is Delivery.RETAINED
        key = key_for(channel, name, wildcard=True)
        self._subscribe(key, codec, inbox, Delivery.RETAINED if retained else Delivery.REALTIME)
        return inbox

    def attend(
        self, channel: Channel[MessageT], name: str, answer: Callable[[Received[MessageT]], None]
    ) -> None:
        """Answer each message at once; see `rtcore.bus.Bus.attend`."""
        self.check_open()
        if channel.delivery is not Delivery.REALTIME:
            raise ValueError(f"channel {channel.name} is {channel.delivery.value}: only realtime is attended")
        codec = Codec(channel, self._rejections, name)
        key = key_for(channel, name, wildcard=True)
        self._subscribe(key, codec, Attendant(codec, answer), channel.delivery)

    def queue(
        self, channel: Channel[MessageT], name: str = "", *, capacity: int = 10_000
    ) -> QueueReader[MessageT]:
        """A reader of every message; see `rtcore.bus.Bus.queue`."""
        self.check_open()
        codec = Codec(channel, self._rejections, name)
        inbox = QueueInbox(codec, capacity, self._bell(), self._clock.now_ns)
        self._subscribe(key_for(channel, name, wildcard=True), codec, inbox, channel.delivery)
        return inbox

    def reject(self, channel: Channel[MessageT], reason: object) -> None:
        """Count a message that its reader refuses; see `rtcore.bus.Bus.reject`."""
        self._rejections.count(channel.name, reason)

    def rejected(self) -> dict[str, int]:
        """Messages refused so far, per channel name."""
        return self._rejections.counts()

    def check_open(self) -> None:
        """Raise BusClosedError once the bus is closed."""
        if self._closed:
            raise BusClosedError(f"the bus of {self._owner} is closed")

    @abstractmethod
    def close(self) -> None:
        """Leave; see `rtcore.bus.Bus.close`."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def _bell(self) -> Bell:
        """What a reader waits on."""

    @abstractmethod
    def _subscribe(self, key: str, codec: Codec[MessageT], inbox: Inbox, delivery: Delivery) -> None:
        """Fill `inbox` from `key` as `delivery` promises: history first if LOSSLESS or RETAINED."""
