"""The bus between processes, over Zenoh.

Callbacks run on Zenoh's receiving threads, which carry all topics of a link: they stamp, keep the bytes
and return. The one exception is `attend`, for an answer that cannot wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from queue import SimpleQueue

import zenoh
from zenoh import ext, handlers

from rtcore.base_bus import BaseBus
from rtcore.bus import BusError, Publisher
from rtcore.cast import role_of
from rtcore.channels import ALIVE_KEY, CONTROL_KEY, PROCESSES, Channel, Delivery, MessageT
from rtcore.clock import Clock
from rtcore.codec import Codec, check_name, key_for, name_in
from rtcore.commands import CommandClient, CommandServer
from rtcore.inbox import Bell, Inbox, ThreadBell
from rtcore.lossless import Fetch, LosslessFeed
from rtcore.messages import Command, CommandReply
from rtcore.signing import OPERATOR, identity
from rtcore.zenoh_access import FLUSH_KEY
from rtcore.zenoh_config import CLIENT, NO_MORE, Endpoints, Security, session_config
from rtcore.zenoh_ports import local_ports
from rtcore.zenoh_router import through_router
from rtcore.zenoh_senders import LOSSLESS_CACHE, ZenohPublisher, declare_sender
from rtcore.zenoh_session import close_session, open_session, realtime_subscriber

FETCH_TIMEOUT_S = 5.0  # for the history of a publisher met in mid-stream
FLUSH_S, FLUSH_RETRY_S = 0.5, 0.02
JOIN_LIMIT_S = 1.0  # it ends within FETCH_PAUSE_S
RETRY_S = 0.1  # before an unanswered command's second try; the queue of replies may be empty on reconnection


def open_bus(
    process: str,
    run_name: str,
    socket_dir: Path,
    *,
    clock: Clock,
    peers: Sequence[str] = PROCESSES,
    endpoints: Endpoints = NO_MORE,
    secure: str = "",
    log_filter: str = "",
) -> ZenohBus:
    """Join a run. Use it in a `with` block: a process that ends without `close` may hang or abort.

    Returns within half a second, whoever is there. Zenoh's threads inherit the caller's scheduling.

    Args:
        process: one of `peers`, or "client".
        run_name: the run.
        socket_dir: a directory of mode 0700; every process's socket is in it.
        clock: gives the stamps of received messages.
        peers: the names of all processes of the run, in connect order (`rtcore.cast.names`).
        endpoints: further ones.
        secure: the directory with the keys of each role; empty: unix sockets, and endpoints as they are.
        log_filter: what Zenoh writes to standard output; see `zenoh_watch`.

    Raises:
        ValueError: an argument that no session can be made of.
        ConfigError: a certificate or an endpoint does not do for secured links.
        BusError: Zenoh refuses, as when a process of this name runs already.
    """
    found = identity(secure, OPERATOR if process == CLIENT else role_of(process))
    security = None if found is None else Security(found, local_ports(socket_dir, peers))
    settings = session_config(
        process, run_name, socket_dir, peers=peers, endpoints=endpoints, security=security
    )
    return _join(settings, process, f"the run in {socket_dir}", clock, log_filter)


def open_bus_by_router(
    process: str, run_name: str, router: str, *, clock: Clock, peers: Sequence[str] = PROCESSES
) -> ZenohBus:
    """Join a run by the Zenoh router at the endpoint `router` alone; otherwise see `open_bus`."""
    settings = through_router(session_config(process, run_name, Path(), peers=peers), router)
    return _join(settings, process, f"a run by {router}", clock)


def _join(
    settings: dict[str, object], process: str, where: str, clock: Clock, log_filter: str = ""
) -> ZenohBus:
    try:
        session = open_session(settings, log_filter)
    except zenoh.ZError as error:
        raise BusError(f"{process} cannot join {where} (does it run already?): {error}") from error
    bus = ZenohBus(session, process, clock)
    bus.join()
    return bus


def _on_reply(on_sample: Callable[[zenoh.Sample], None], reply: zenoh.Reply) -> None:
    if reply.ok is not None:
        on_sample(reply.ok)


def _on_flush(query: zenoh.Query) -> None:
    with query:
        query.reply(FLUSH_KEY, b"")


class ZenohBus(BaseBus):
    """One process's connection to the run; see `rtcore.bus.Bus`. Made by `open_bus`."""

    def __init__(self, session: zenoh.Session, process: str, clock: Clock) -> None:
        super().__init__(process, clock)
        self._session = session
        self._held: list[object] = []  # Zenoh drops what nobody refers to
        self._lock = threading.Lock()
        self._alive: set[str] = set()
        self._publishes = False
        self._wanted: SimpleQueue[Fetch | None] = SimpleQueue()
        self._fetcher = threading.Thread(target=self._fetch_missing, name="fetcher", daemon=True)

    def publisher(self, channel: Channel[MessageT], name: str = "") -> Publisher[MessageT]:
        """A publisher; see `rtcore.bus.Bus.publisher`."""
        self.check_open()
        sender = declare_sender(self._session, key_for(channel, name, wildcard=False), channel.delivery)
        self._held.append(sender)  # with what it keeps for late readers
        self._publishes = True
        return ZenohPublisher(Codec(channel, self._rejections), sender)

    def serve(self, name: str, handler: Callable[[Command], CommandReply]) -> None:
        """Answer commands on a thread of their own; see `rtcore.bus.Bus.serve`."""
        self.check_open()
        check_name(name)
        key = CONTROL_KEY.format(name=name)
        server = CommandServer(handler, self._rejections)

        def on_query(query: zenoh.Query) -> None:
            with query:
                answer = server.answer(b"" if query.payload is None else query.payload.to_bytes())
                if answer is not None:
                    query.reply(key, answer)

        self._held.append(self._session.declare_queryable(key, on_query))

    def ask(self, name: str, command: Command, timeout_s: float = 1.0, tries: int = 3) -> CommandReply:
        """Send a command; see `rtcore.bus.Bus.ask`."""
        check_name(name)
        client = CommandClient(command, self._rejections)
        for attempt in range(tries):
            if attempt:
                time.sleep(RETRY_S * attempt)
            self.check_open()
            for answer in self._session.get(
                CONTROL_KEY.format(name=name),
                payload=client.payload,
                timeout=timeout_s,
                target=zenoh.QueryTarget.ALL,
            ):
                reply = None if answer.ok is None else client.accept(answer.ok.payload.to_bytes())
                if reply is not None:
                    return reply
        raise client.no_answer(name, timeout_s, tries)

    def declare_alive(self, name: str) -> None:
        """Let the others see `name`; see `rtcore.bus.Bus.declare_alive`."""
        self.check_open()
        check_name(name)
        self._held.append(self._session.liveliness().declare_token(ALIVE_KEY.format(name=name)))

    def alive(self) -> frozenset[str]:
        """Who is connected; see `rtcore.bus.Bus.alive`."""
        self.check_open()
        with self._lock:
            return frozenset(self._alive)

    def join(self) -> None:
        """Begin to follow who is connected, and serve the needs of lossless channels; once."""
        self._fetcher.start()
        self._held.append(
            self._session.declare_queryable(FLUSH_KEY, handlers.Callback(_on_flush, indirect=False))
        )
        self._held.append(
            self._session.liveliness().declare_subscriber(
                ALIVE_KEY.format(name="*"), handlers.Callback(self._on_alive, indirect=False), history=True
            )
        )

    def close(self) -> None:
        """Leave the run: in milliseconds, or in a second or two where stopped processes are given up."""
        first, self._closed = not self._closed, True
        if first and self._publishes:
            self._flush()
        self._wanted.put(None)
        close_session(self._session)
        # A thread that comes back from Zenoh while the interpreter ends would abort the process.
        self._fetcher.join(JOIN_LIMIT_S)

    def _flush(self) -> None:
        """Wait until everybody has received what was put, as far as they do within FLUSH_S.

        Closing drops what still waits to be sent: without this, 7 of 40 readers of a 3 MB burst lost its
        last messages. A query overtakes nothing of its own or a higher priority, so the replies mean that
        all is through. It is dropped where the way is blocked, hence the tries.
        """
        deadline = time.monotonic() + FLUSH_S
        while (remaining := deadline - time.monotonic()) > 0:
            peers = len(self._session.info.peers_zid())
            replies = self._session.get(
                FLUSH_KEY,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW,
                allowed_destination=zenoh.Locality.REMOTE,
                timeout=remaining,
            )
            if sum(reply.ok is not None for reply in replies) >= peers:
                return
            time.sleep(FLUSH_RETRY_S)

    def _bell(self) -> Bell:
        return ThreadBell()

    def _on_alive(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).rpartition("/")[2]
        with self._lock:
            if sample.kind == zenoh.SampleKind.PUT:
                self._alive.add(name)
            else:
                self._alive.discard(name)

    def _subscribe(self, key: str, codec: Codec[MessageT], inbox: Inbox, delivery: Delivery) -> None:
        now_ns, fits, offer, wild = self._clock.now_ns, codec.fits, inbox.offer, "*" in key

        def on_sample(sample: zenoh.Sample) -> None:
            received_ns = now_ns()
            payload = sample.payload
            if fits(len(payload)):
                offer(payload.to_bytes(), received_ns, name_in(str(sample.key_expr)) if wild else "")

        if delivery in (Delivery.REALTIME, Delivery.TELEMETRY):
            self._held.append(realtime_subscriber(self._session, key, on_sample))
            return
        depth, direct = 1, handlers.Callback(on_sample, indirect=False)
        if delivery is Delivery.LOSSLESS:
            depth = LOSSLESS_CACHE
            feed = LosslessFeed(codec, inbox, now_ns, self._wanted.put)
            direct = handlers.Callback(feed.on_sample, indirect=False)
        self._held.append(
            ext.declare_advanced_subscriber(
                self._session,
                key,
                direct,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=depth),
                recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
        )

    def _fetch_missing(self) -> None:
        """Ask publishers' caches, on a thread of its own: Zenoh may call back with its routing tables locked,
        where a query of ours would wait for ever (seen in 1 of 8 links given up).
        """
        while (wanted := self._wanted.get()) is not None and not self._closed:
            time.sleep(wanted.pause_s)
            try:
                self._session.get(
                    wanted.selector,
                    handlers.Callback(partial(_on_reply, wanted.on_sample), wanted.done, indirect=False),
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    accept_replies=zenoh.ReplyKeyExpr.ANY,
                    timeout=FETCH_TIMEOUT_S,
                )
            except zenoh.ZError:  # the bus closes
                wanted.done()
