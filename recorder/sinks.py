"""Where rows go: the file, which has everything, and a live stream, which sheds what a viewer cannot take.

They are two recording streams with one application id and one recording id. Teed in one stream, a
stalled viewer can freeze the file; side by side, the file does not notice (both measured, rerun 0.41).
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import assert_never

import rerun as rr
import rerun.blueprint as rrb

from recorder.rows import Index, Lines, Payload, Poses, Rows, Scalars, States
from rtcore.clock import Clock

APPLICATION = "tenuto"  # blueprints belong to an application
HOST = "127.0.0.1"
LIVE_MEMORY = "128MiB"  # what a viewer that joins late still gets; then the oldest goes
# A stalled viewer shows in a flush that does not end; 0 s would say "ended" even then (measured). So
# the file waits at most 20 ms, once in 5 s.
FLUSH_S = 0.02
RETRY_NS = 5_000_000_000
SYNC_S = 5.0
CLOSE_S = 10.0


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
    """An open recording file and, perhaps, its live stream."""

    def __init__(
        self, file: rr.RecordingStream, live_stream: rr.RecordingStream | None, clock: Clock
    ) -> None:
        self._file = file
        self._streams = [file] if live_stream is None else [file, live_stream]
        self.live = None if live_stream is None else LiveStream(live_stream, clock)
        self.rows = 0  # written to the file

    def dashboard(self, make: Callable[[bool], rrb.Blueprint]) -> None:
        """Embed the dashboard: `make(live)` gives the one for the live stream or for the file."""
        for stream in self._streams:
            stream.send_blueprint(make(stream is not self._file), make_active=True, make_default=True)

    def static(self, entity: str, *archetypes: rr.AsComponents) -> None:
        """Say something that holds at all times: looks, texts, shapes."""
        for stream in self._streams:
            stream.log(entity, *archetypes, static=True, strict=True)

    def start_time(self, wall_ns: int) -> None:
        """When the run began, Unix ns."""
        for stream in self._streams:
            stream.send_recording_start_time_nanos(wall_ns)

    def write(self, rows: Rows) -> None:
        """Write rows; after `sync` the file has them."""
        index, columns = time_columns(rows.index), payload_columns(rows.payload)
        self._file.send_columns(rows.entity, index, columns, strict=True)
        self.rows += len(rows.index)
        if self.live is not None:
            self.live.send(rows.entity, index, columns, len(rows.index))

    def sync(self) -> bool:
        """Wait until the file has all rows, so that a kill -9 loses none; False: not within 5 s.

        0.4 ms for 14 chunks. Without it, the thread that writes was seen to be more than a second behind on
        busy cores.
        """
        try:
            self._file.flush(timeout_sec=SYNC_S)
        except RuntimeError:
            return False
        return True

    def close(self) -> None:
        """Write the footer and end both streams."""
        self._file.flush(timeout_sec=CLOSE_S)
        self._file.disconnect()
        if self.live is not None:
            self.live.close()


def open_recording(path: Path, run: str, clock: Clock, live_port: int | None = None) -> Recording:
    """Open `path` (overwritten) and, with a port, a server for viewers on this machine.

    Raises:
        OSError: the port is taken; the file is not opened then.
    """
    live = None if live_port is None else _stream(run, _server(live_port))
    return Recording(_stream(run, rr.FileSink(path)), live, clock)


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


def _stream(run: str, sink: rr.FileSink | rr.GrpcServerSink) -> rr.RecordingStream:
    stream = rr.RecordingStream(APPLICATION, recording_id=run)
    stream.set_sinks(sink)
    stream.send_recording_name(run)
    return stream


def _server(port: int) -> rr.GrpcServerSink:
    with socket.socket() as probe:  # the sink itself would only log that the port is taken
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((HOST, port))
    return rr.GrpcServerSink(HOST, port, server_memory_limit=LIVE_MEMORY)
