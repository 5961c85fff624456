"""The bus inside one process: synchronous and deterministic, for `tenuto sim` and for tests.

It keeps what the Zenoh bus keeps: every message is encoded and decoded, bad ones are counted, late
readers get what LOSSLESS and RETAINED publishers hold. A put has arrived everywhere when it returns.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic

from rtcore.base_bus import BaseBus
from rtcore.bus import Publisher
from rtcore.channels import Channel, Delivery, MessageT
from rtcore.clock import Clock, VirtualClock
from rtcore.codec import Codec, check_name, key_for, name_in
from rtcore.commands import CommandClient, CommandServer
from rtcore.inbox import Bell, Inbox, ThreadBell
from rtcore.messages import Command, CommandReply

# What a publisher keeps for late readers; the Zenoh bus keeps as much.
KEPT = {Delivery.REALTIME: 0, Delivery.TELEMETRY: 0, Delivery.LOSSLESS: 2000, Delivery.RETAINED: 1}


class VirtualBell:
    """A bell on a virtual clock. Nobody can ring while its one thread waits, so all the time passes."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def ring(self) -> None:
        """Nobody waits."""

    def wait(self, timeout_s: float) -> bool:
        """Let the time pass."""
        self._clock.sleep_until_ns(self._clock.now_ns() + round(timeout_s * 1e9))
        return False


@dataclass(frozen=True, eq=False)
class _Subscription:
    """One reader's key and how it takes bytes and the key they came on."""

    bus: MemoryBus
    key: str
    receive: Callable[[bytes, str], None]

    def matches(self, key: str) -> bool:
        """Whether `key` is meant; `*` stands for one chunk."""
        mine, theirs = self.key.split("/"), key.split("/")
        return len(mine) == len(theirs) and all(m in ("*", t) for m, t in zip(mine, theirs, strict=True))


@dataclass(frozen=True, eq=False)
class _Journal:
    """What one publisher keeps for late readers: (place in the order of all puts, bytes)."""

    bus: MemoryBus
    key: str
    kept: deque[tuple[int, bytes]]


class _Exchange:
    """What the buses of one hub share: who reads, keeps, serves and lives."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._subscriptions: list[_Subscription] = []
        self._routes: dict[str, tuple[_Subscription, ...]] = {}  # derived: subscriptions per key
        self._journals: list[_Journal] = []
        self._servers: list[tuple[MemoryBus, str, CommandServer]] = []
        self._alive: list[tuple[MemoryBus, str]] = []
        self._puts = 0

    def deliver(self, key: str, payload: bytes) -> None:
        with self._lock:
            route = self._routes.get(key)
            if route is None:
                route = self._routes[key] = tuple(s for s in self._subscriptions if s.matches(key))
            for subscription in route:
                subscription.receive(payload, key)

    def publish(self, journal: _Journal, payload: bytes) -> None:
        with self._lock:
            self._puts += 1
            journal.kept.append((self._puts, payload))
            self.deliver(journal.key, payload)

    def keep(self, journal: _Journal) -> None:
        with self._lock:
            self._journals.append(journal)

    def subscribe(self, subscription: _Subscription, *, history: bool) -> None:
        with self._lock:
            if history:
                journals = [journal for journal in self._journals if subscription.matches(journal.key)]
                kept = sorted((*entry, journal.key) for journal in journals for entry in journal.kept)
                for _, payload, key in kept:
                    subscription.receive(payload, key)
            self._subscriptions.append(subscription)
            self._routes.clear()

    def serve(self, bus: MemoryBus, name: str, server: CommandServer) -> None:
        with self._lock:
            self._servers.append((bus, name, server))

    def server(self, name: str) -> CommandServer | None:
        with self._lock:
            return next((server for _, served, server in self._servers if served == name), None)

    def declare_alive(self, bus: MemoryBus, name: str) -> None:
        with self._lock:
            self._alive.append((bus, name))

    def alive(self) -> frozenset[str]:
        with self._lock:
            return frozenset(name for _, name in self._alive)

    def leave(self, bus: MemoryBus) -> None:
        with self._lock:
            self._subscriptions = [entry for entry in self._subscriptions if entry.bus is not bus]
            self._routes.clear()
            self._journals = [entry for entry in self._journals if entry.bus is not bus]
            self._servers = [entry for entry in self._servers if entry[0] is not bus]
            self._alive = [entry for entry in self._alive if entry[0] is not bus]


class MemoryHub:
    """Connects the buses made from it. Usable from several threads, deterministic in one."""

    def __init__(self) -> None:
        self._exchange = _Exchange()

    def bus(self, name: str, clock: Clock) -> MemoryBus:
        """A process's bus; `name` is for people. Stamps come from `clock`."""
        return MemoryBus(self._exchange, name, clock)

    def inject(self, key: str, payload: bytes) -> None:
        """Deliver raw bytes on a key, as a broken or hostile process would."""
        self._exchange.deliver(key, payload)


class _MemoryPublisher(Generic[MessageT]):
    """Sends on one key of a hub; see `rtcore.bus.Publisher`."""

    def __init__(self, bus: MemoryBus, codec: Codec[MessageT], publish: Callable[[bytes], None]) -> None:
        self._bus = bus
        self._codec = codec
        self._publish = publish

    def put(self, message: MessageT) -> None:
        """Send; it has arrived everywhere when this returns."""
        self._bus.check_open()
        self._publish(self._codec.encode(message))


class MemoryBus(BaseBus):
    """One process's connection to a hub; see `rtcore.bus.Bus`. Made by `MemoryHub.bus`.

    With a VirtualClock a reader's `wait` does not wait: the clock moves on by the timeout.
    """

    def __init__(self, exchange: _Exchange, name: str, clock: Clock) -> None:
        super().__init__(name, clock)
        self._exchange = exchange

    def publisher(self, channel: Channel[MessageT], name: str = "") -> Publisher[MessageT]:
        """A publisher; see `rtcore.bus.Bus.publisher`."""
        self.check_open()
        key = key_for(channel, name, wildcard=False)
        journal = _Journal(self, key, deque(maxlen=KEPT[channel.delivery]))
        self._exchange.keep(journal)
        return _MemoryPublisher(
            self, Codec(channel, self._rejections), lambda payload: self._exchange.publish(journal, payload)
        )

    def serve(self, name: str, handler: Callable[[Command], CommandReply]) -> None:
        """Answer commands, on the asker's thread; see `rtcore.bus.Bus.serve`."""
        self.check_open()
        check_name(name)
        self._exchange.serve(self, name, CommandServer(handler, self._rejections))

    def ask(self, name: str, command: Command, timeout_s: float = 1.0, tries: int = 3) -> CommandReply:
        """Send a command; see `rtcore.bus.Bus.ask`. Never waits: if nobody serves, nobody will."""
        self.check_open()
        check_name(name)
        client = CommandClient(command, self._rejections)
        server = self._exchange.server(name)
        answer = None if server is None else server.answer(client.payload)
        reply = None if answer is None else client.accept(answer)
        if reply is None:
            raise client.no_answer(name, timeout_s, tries)
        return reply

    def declare_alive(self, name: str) -> None:
        """Let the others see `name`; see `rtcore.bus.Bus.declare_alive`."""
        self.check_open()
        check_name(name)
        self._exchange.declare_alive(self, name)

    def alive(self) -> frozenset[str]:
        """Who is connected; see `rtcore.bus.Bus.alive`."""
        self.check_open()
        return self._exchange.alive()

    def close(self) -> None:
        """Leave the hub. A second close does nothing."""
        self._closed = True
        self._exchange.leave(self)

    def _bell(self) -> Bell:
        return VirtualBell(self._clock) if isinstance(self._clock, VirtualClock) else ThreadBell()

    def _subscribe(self, key: str, codec: Codec[MessageT], inbox: Inbox, delivery: Delivery) -> None:
        wild = "*" in key

        def receive(payload: bytes, put_on: str) -> None:
            if codec.fits(len(payload)):
                inbox.offer(payload, self._clock.now_ns(), name_in(put_on) if wild else "")

        self._exchange.subscribe(_Subscription(self, key, receive), history=KEPT[delivery] > 0)
