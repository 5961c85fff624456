"""The transports that others put between a robot and its policy, as plain ways for bytes.

| name | is | as in | its sender |
|---|---|---|---|
| grpc-unary | a gRPC call per observation | LeRobot's asynchronous inference | waits |
| grpc-stream | one bidirectional gRPC stream | the same, with one call instead of two | waits |
| grpc-stream-async | the same, its answers read on a thread | | goes on |
| zeromq | a ZeroMQ REQ/REP pair | agentlace (SERL) | waits |
| zeromq-async | a PUSH/PULL pair each way, the answers read on a thread | | goes on |

All over unix sockets, with raw bytes instead of protobuf or pickle. A sender that waits for its answer on
the thread that asked has no hand-over to another one, so it is the faster of the two; but a clock may not
wait for anybody, so only those that go on do the env server's work.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Literal, get_args

from rtcore.config import ConfigError
from rtcore.lifecycle import Stop

if TYPE_CHECKING:
    import zmq

Transport = Literal["grpc-unary", "grpc-stream", "grpc-stream-async", "zeromq", "zeromq-async"]
TRANSPORTS: tuple[Transport, ...] = get_args(Transport)
WAITING: tuple[Transport, ...] = ("grpc-unary", "grpc-stream", "zeromq")
Send = Callable[[bytes], None]
OnAnswer = Callable[[bytes], None]
Answer = Callable[[bytes], bytes]

LIMIT_S = 2.0  # an answer that takes longer ends the benchmark
POLL_S = 0.1
WORKERS = 4  # threads of the gRPC server
SERVICE, STREAM, UNARY = "tenuto.Peer", "Stream", "Unary"


@contextmanager
def connect(transport: Transport, socket: Path, on_answer: OnAnswer) -> Iterator[Send]:
    """The sender's half. `on_answer` is called with each answer: before `send` returns if the transport
    waits, else on a thread of its own. Errors are the library's: a benchmark has nothing to rescue.

    Raises:
        ConfigError: no such transport.
    """
    check(transport)
    if transport == "grpc-unary":
        opening = _grpc_unary(socket, on_answer)
    elif transport in ("grpc-stream", "grpc-stream-async"):
        opening = _grpc_stream(socket, on_answer, waits=transport in WAITING)
    elif transport == "zeromq":
        opening = _zeromq(socket, on_answer)
    else:
        opening = _zeromq_async(socket, on_answer)
    with opening as send:
        yield send


def serve(transport: Transport, socket: Path, answer: Answer, stop: Stop, ready: Callable[[], None]) -> None:
    """Answer requests until stopped; calls `ready` once, when a sender may come.

    Raises:
        ConfigError: no such transport.
    """
    check(transport)
    if transport == "zeromq":
        _serve_zeromq(socket, answer, stop, ready)
    elif transport == "zeromq-async":
        _serve_zeromq_async(socket, answer, stop, ready)
    else:
        _serve_grpc(socket, answer, stop, ready)


def check(transport: str) -> None:
    """Raise ConfigError unless there is such a transport."""
    if transport not in TRANSPORTS:
        raise ConfigError("transport", transport, f"must be one of {', '.join(TRANSPORTS)}")


@contextmanager
def _grpc_unary(socket: Path, on_answer: OnAnswer) -> Iterator[Send]:
    import grpc

    with grpc.insecure_channel(f"unix:{socket}") as channel:
        call = channel.unary_unary(f"/{SERVICE}/{UNARY}")
        yield lambda request: on_answer(call(request, timeout=LIMIT_S))


@contextmanager
def _grpc_stream(socket: Path, on_answer: OnAnswer, *, waits: bool) -> Iterator[Send]:
    import grpc

    requests: SimpleQueue[bytes | None] = SimpleQueue()

    def read() -> None:
        with suppress(grpc.RpcError):  # cancelled at the end
            for answer in answers:
                on_answer(answer)

    def send(request: bytes) -> None:
        requests.put(request)
        if waits:
            on_answer(next(answers))

    with grpc.insecure_channel(f"unix:{socket}") as channel:
        answers = channel.stream_stream(f"/{SERVICE}/{STREAM}")(iter(requests.get, None))
        reader = threading.Thread(target=read, daemon=True)
        if not waits:
            reader.start()
        try:
            yield send
        finally:
            requests.put(None)
            answers.cancel()
            if not waits:
                reader.join(LIMIT_S)


@contextmanager
def _zeromq(socket: Path, on_answer: OnAnswer) -> Iterator[Send]:
    import zmq

    with zmq.Context() as context, context.socket(zmq.REQ) as link:
        _settle(link, LIMIT_S)
        link.connect(f"ipc://{socket}")

        def send(request: bytes) -> None:
            link.send(request)
            on_answer(link.recv())

        yield send


@contextmanager
def _zeromq_async(socket: Path, on_answer: OnAnswer) -> Iterator[Send]:
    import zmq

    stop = Stop()

    def read() -> None:  # a ZeroMQ socket belongs to one thread
        with context.socket(zmq.PULL) as back:
            _settle(back, POLL_S)
            back.connect(f"ipc://{socket}.back")
            while not stop.is_set():
                with suppress(zmq.Again):
                    on_answer(back.recv())

    with zmq.Context() as context, context.socket(zmq.PUSH) as out:
        _settle(out, POLL_S)
        out.connect(f"ipc://{socket}")
        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        try:
            yield out.send
        finally:
            stop.set("done")
            reader.join(LIMIT_S)


def _settle(link: zmq.Socket[bytes], limit_s: float) -> None:
    """No wait is endless, neither for a message nor at the end."""
    link.rcvtimeo = round(limit_s * 1e3)
    link.linger = 0


def _serve_zeromq(socket: Path, answer: Answer, stop: Stop, ready: Callable[[], None]) -> None:
    import zmq

    with zmq.Context() as context, context.socket(zmq.REP) as link:
        _settle(link, POLL_S)
        link.bind(f"ipc://{socket}")
        ready()
        while not stop.is_set():
            with suppress(zmq.Again):
                link.send(answer(link.recv()))


def _serve_zeromq_async(socket: Path, answer: Answer, stop: Stop, ready: Callable[[], None]) -> None:
    import zmq

    with zmq.Context() as context, context.socket(zmq.PULL) as link, context.socket(zmq.PUSH) as back:
        _settle(link, POLL_S)
        _settle(back, POLL_S)
        link.bind(f"ipc://{socket}")
        back.bind(f"ipc://{socket}.back")
        ready()
        while not stop.is_set():
            with suppress(zmq.Again):
                back.send(answer(link.recv()), zmq.NOBLOCK)


def _serve_grpc(socket: Path, answer: Answer, stop: Stop, ready: Callable[[], None]) -> None:
    import grpc

    def unary(request: bytes, _context: Any) -> bytes:
        return answer(request)

    def stream(requests: Iterator[bytes], _context: Any) -> Iterator[bytes]:
        return map(answer, requests)

    handlers = {
        UNARY: grpc.unary_unary_rpc_method_handler(unary),
        STREAM: grpc.stream_stream_rpc_method_handler(stream),
    }
    server = grpc.server(ThreadPoolExecutor(WORKERS))
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))
    server.add_insecure_port(f"unix:{socket}")
    server.start()
    ready()
    while not stop.wait(POLL_S):
        pass
    server.stop(grace=POLL_S).wait()
