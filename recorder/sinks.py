"""Where rows go: the file, which has everything, and a live stream, which sheds what a viewer cannot take.

They are two recording streams with one application id and one recording id. Teed in one stream, a
stalled viewer can freeze the file; side by side, the file does not notice (both measured, rerun 0.41).
What the disk does not take is dropped and counted; what gives the rows their looks is kept until it does.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import assert_never

import rerun as rr
import rerun.blueprint as rrb

from recorder.disk import RecordingFile, unframed
from recorder.place import Place
from recorder.rows import Index, Lines, Payload, Poses, Rows, Scalars, States
from rtcore.clock import Clock

APPLICATION = "tenuto"  # blueprints belong to an application
HOST = "127.0.0.1"
LIVE_MEMORY = "128MiB"  # what a viewer that joins late still gets; then the oldest goes
# A stalled viewer shows in a flush that does not end; 0 s would say "ended" even then (measured). So
# the file waits at most 20 ms, once in 5 s.
FLUSH_S = 0.02
RETRY_NS = 5_000_000_000
# 0.5 ms for 14 chunks; the threads that encode were seen more than a second behind on busy cores.
ENCODE_S = 5.0


class LiveStream:
    """A gRPC server that viewers on this machine connect to. Never waited for: what stalls is dropped."""

    def __init__(self, stream: rr.RecordingStream, clock: Clock) -> None:
        self._stream = stream
        self._clock = clock
        self._retry_ns = 0
        self.dropped = 0  # rows not sent

    @property
    def stalled(self) -> bool:
        """Whether the viewer did not keep up lately."""
        return self._clock.now_ns() < self._retry_ns

    def send(
        self, entity: str, index: Sequence[rr.TimeColumn], columns: rr.ComponentColumnList, n: int
    ) -> None:
        """Send n rows, or count them as dropped."""
        if self.stalled:
            self.dropped += n
        else:
            self._stream.send_columns(entity, index, columns, strict=True)

    def pump(self) -> bool:
        """Look after the viewer; False: it has just stalled."""
        if self.stalled:
            return True
        try:
            self._stream.flush(timeout_sec=FLUSH_S)
        except RuntimeError:
            self._retry_ns = self._clock.now_ns() + RETRY_NS
            return False
        return True

    def close(self) -> None:
        """Stop serving."""
        self._stream.disconnect()


class Recording:
    """A recording in the making: a file and, perhaps, a live stream.

    Attributes:
        rows: in the file.
        dropped: rows that the disk did not take.
    """

    def __init__(
        self,
        file: RecordingFile,
        stream: rr.RecordingStream,
        live_stream: rr.RecordingStream | None,
        clock: Clock,
    ) -> None:
        self.file = file
        self._stream = stream
        self._encoded = rr.binary_stream(recording=stream)
        self._streams = [stream] if live_stream is None else [stream, live_stream]
        self.live = None if live_stream is None else LiveStream(live_stream, clock)
        self._head = b""
        self._lasting = b""  # what holds at all times, and is not in the file yet
        self._passing = b""  # rows
        self._index: Index | None = None  # of the last rows ...
        self._times: list[rr.TimeColumn] = []  # ... and what became of it
        self._waiting = 0  # how many rows were sent since the last `sync`
        self.rows = 0
        self.dropped = 0

    def name(self, run: str) -> None:
        """What the recording is called."""
        with self._for_good():
            for stream in self._streams:
                stream.send_recording_name(run)

    def dashboard(self, make: Callable[[bool], rrb.Blueprint]) -> None:
        """Embed the dashboard: `make(live)` gives the one for the live stream or for the file."""
        with self._for_good():
            for stream in self._streams:
                stream.send_blueprint(make(stream is not self._stream), make_active=True, make_default=True)

    def static(self, entity: str, *archetypes: rr.AsComponents) -> None:
        """Say something that holds at all times: looks, texts, shapes."""
        with self._for_good():
            for stream in self._streams:
                stream.log(entity, *archetypes, static=True, strict=True)

    def start_time(self, wall_ns: int) -> None:
        """When the run began, Unix ns."""
        with self._for_good():
            for stream in self._streams:
                stream.send_recording_start_time_nanos(wall_ns)

    def write(self, rows: Rows) -> None:
        """Write rows; after `sync` the file has them."""
        if rows.index is not self._index:  # many entities in a row stand on the same one: 27 us each
            self._index, self._times = rows.index, time_columns(rows.index)
        index, columns = self._times, payload_columns(rows.payload)
        self._stream.send_columns(rows.entity, index, columns, strict=True)
        self._waiting += len(rows.index)
        if self.live is not None:
            self.live.send(rows.entity, index, columns, len(rows.index))

    def sync(self, place: Place) -> bool:
        """Have the file take all that was written, so that a kill -9 loses none of it, or count its rows as
        dropped; the recording has then got to `place`. False: it is not encoded yet, within 5 s.
        """
        passing = self._messages()
        if passing is None:
            return False
        self._passing += passing
        if self.file.append(self._lasting + self._passing, place):
            self._lasting = b""
            self.rows += self._waiting
        else:
            self.dropped += self._waiting
        self._passing, self._waiting = b"", 0
        return True

    def close(self) -> None:
        """End the file and the live stream; rows that were not synced count as dropped."""
        self.dropped, self._waiting = self.dropped + self._waiting, 0
        self._stream.disconnect()
        self.file.close()
        if self.live is not None:
            self.live.close()

    @contextmanager
    def _for_good(self) -> Iterator[None]:
        """What is sent inside the block is kept until the file has it."""
        before = self._messages() or b""
        if self._waiting:
            self._passing += before
        else:
            self._lasting += before
        yield
        self._lasting += self._messages() or b""

    def _messages(self) -> bytes | None:
        """What was sent since the last call, as it goes into the file: the head first, and no end. None: it
        is not encoded within 5 s; the next call has it.
        """
        try:
            encoded = self._encoded.read(flush=True, flush_timeout_sec=ENCODE_S)
        except RuntimeError:
            return None
        if encoded is None:
            return b""
        head, messages = unframed(encoded)
        if not self._head:
            self._head = head
            return head + messages
        return messages


def open_recording(file: RecordingFile, run: str, clock: Clock, live_port: int | None = None) -> Recording:
    """Begin a recording in `file` and, with a port, a server for viewers on this machine.

    Raises:
        OSError: the port is taken.
    """
    live = None
    if live_port is not None:
        server = _server(live_port)
        live = rr.RecordingStream(APPLICATION, recording_id=run)
        live.set_sinks(server)
    recording = Recording(file, rr.RecordingStream(APPLICATION, recording_id=run), live, clock)
    recording.name(run)
    return recording


def live_url(port: int) -> str:
    """What a viewer connects to."""
    return f"rerun+http://{HOST}:{port}/proxy"


def time_columns(index: Index) -> list[rr.TimeColumn]:
    """All five timelines."""
    return [
        rr.TimeColumn("run_time", duration=index.run_time_ns.astype("timedelta64[ns]")),
        rr.TimeColumn("wall", timestamp=index.wall_ns.astype("datetime64[ns]")),
        rr.TimeColumn("tick", sequence=index.tick),
        rr.TimeColumn("episode", sequence=index.episode),
        rr.TimeColumn("unit", sequence=index.unit),
    ]


def payload_columns(payload: Payload) -> rr.ComponentColumnList:
    """The payload as component columns."""
    match payload:
        case Scalars(values):
            return rr.Scalars.columns(scalars=values)
        case States(names):
            return rr.StateChange.columns(state=list(names))
        case Lines(texts, levels):
            return rr.TextLog.columns(text=list(texts), level=list(levels))
        case Poses(translation, quaternion):
            return rr.Transform3D.columns(translation=translation, quaternion=quaternion)
        case _:
            assert_never(payload)


def _server(port: int) -> rr.GrpcServerSink:
    with socket.socket() as probe:  # the sink itself would only log that the port is taken
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((HOST, port))
    return rr.GrpcServerSink(HOST, port, server_memory_limit=LIVE_MEMORY)
