"""The ways between the two processes of the echo: raw Zenoh with the bus's settings, or a unix socket.

Both answer where the message arrives: Zenoh in its callback, the unix socket in a blocking loop.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, Protocol

from rtcore import channels
from rtcore.zenoh_config import session_config
from rtcore.zenoh_session import open_session, realtime_publisher, realtime_subscriber

Transport = Literal["zenoh", "unix"]
Answer = Callable[[bytes], bytes]  # what the server makes of a payload
Receive = Callable[[bytes], None]  # what the client does with an answer; on the receiving thread
Send = Callable[[bytes], None]  # never waits: what does not fit is dropped, and is a miss

STEP_KEY, ACTION_KEY = (channel.key_for("echo") for channel in (channels.STEP, channels.ACTION))
CONNECT_RETRY_S = 0.01
LARGEST_BYTES = 65_536


class Link(Protocol):
    """One kind of way."""

    def client(self, directory: Path, receive: Receive) -> contextlib.AbstractContextManager[Send]:
        """The env server's end, in `directory`; the server's may come later."""

    def server(self, directory: Path, answer: Answer) -> contextlib.AbstractContextManager[None]:
        """The agent's end: it answers for as long as the block runs."""


class ZenohLink:
    """The sessions, publishers and subscribers of the bus's real-time path, without the bus."""

    @contextmanager
    def client(self, directory: Path, receive: Receive) -> Iterator[Send]:
        """Publish steps, and subscribe to actions."""
        with open_session(session_config(channels.ENV_SERVER, "echo", directory)) as session:
            subscriber = realtime_subscriber(
                session, ACTION_KEY, lambda sample: receive(sample.payload.to_bytes())
            )
            yield realtime_publisher(session, STEP_KEY).put
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub has no return type

    @contextmanager
    def server(self, directory: Path, answer: Answer) -> Iterator[None]:
        """Subscribe to steps, and publish an action for each."""
        with open_session(session_config(channels.AGENT, "echo", directory)) as session:
            put = realtime_publisher(session, ACTION_KEY).put
            subscriber = realtime_subscriber(
                session, STEP_KEY, lambda sample: put(answer(sample.payload.to_bytes()))
            )
            yield
            subscriber.undeclare()  # type: ignore[no-untyped-call]


class UnixLink:
    """A connected pair of unix sockets that keep messages whole (SOCK_SEQPACKET)."""

    @contextmanager
    def client(self, directory: Path, receive: Receive) -> Iterator[Send]:
        """Connect, as soon as the server listens, and receive on a thread."""
        with _socket() as connection:
            while connection.connect_ex(str(_path(directory))):
                time.sleep(CONNECT_RETRY_S)
            threading.Thread(target=_receive_all, args=(connection, receive), daemon=True).start()

            def send(payload: bytes) -> None:
                with contextlib.suppress(BlockingIOError):
                    connection.send(payload, socket.MSG_DONTWAIT)

            yield send
            connection.shutdown(socket.SHUT_RDWR)

    @contextmanager
    def server(self, directory: Path, answer: Answer) -> Iterator[None]:
        """Listen, and answer on a thread."""
        with _socket() as listener:
            listener.bind(str(_path(directory)))
            listener.listen(1)
            threading.Thread(target=_answer_all, args=(listener, answer), daemon=True).start()
            yield


LINKS: dict[Transport, Link] = {"zenoh": ZenohLink(), "unix": UnixLink()}


def _socket() -> socket.socket:
    return socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def _path(directory: Path) -> Path:
    return directory / "unix.sock"


def _receive_all(connection: socket.socket, receive: Receive) -> None:
    with contextlib.suppress(OSError):  # closed
        while payload := connection.recv(LARGEST_BYTES):
            receive(payload)


def _answer_all(listener: socket.socket, answer: Answer) -> None:
    with contextlib.suppress(OSError):  # the client has left
        connection, _ = listener.accept()
        with connection:
            while payload := connection.recv(LARGEST_BYTES):
                connection.send(answer(payload))
