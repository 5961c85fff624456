"""The live stream: there or not, fast or stalled, the file has everything."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from recorder import reading
from recorder.disk import RecordingFile
from recorder.finish import switch_off_statistics
from recorder.place import Place
from recorder.rows import Index, Rows, Scalars
from recorder.sinks import FLUSH_S, live_url, open_recording, payload_columns, time_columns
from rtcore.monotonic import MonotonicClock
from tests.recorder.stage import SPEC, make_step, set_stage


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def viewer(port: int, into: Path) -> Iterator[int]:
    """A viewer without a window: a client that saves what it is sent. Yields its process id."""
    home = into.with_suffix(".home")
    switch_off_statistics(home)
    with subprocess.Popen(
        [sys.executable, "-m", "rerun_cli", "--save", str(into), live_url(port)],
        env={"HOME": str(home)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        process_group=0,
    ) as wrapper:
        try:
            until(lambda: into.exists() and into.stat().st_size > 500)  # it is connected
            children = Path(f"/proc/{wrapper.pid}/task/{wrapper.pid}/children").read_text().split()
            yield int(children[0])
        finally:
            os.killpg(wrapper.pid, signal.SIGKILL)


def until(condition: object) -> None:
    assert callable(condition)
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.02)


def table(number: int, *, rows: int = 10, series: int = 1) -> Rows:
    at = np.arange(number * rows, (number + 1) * rows, dtype=np.int64)
    values = np.random.default_rng(number).random((rows, series))  # what compresses fills no buffer
    return Rows("/x", Index(at, at, at, at, at), Scalars(values))


def test_a_taken_port_is_told_and_the_file_is_recorded_all_the_same(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = int(other.getsockname()[1])
        stage = set_stage(tmp_path, view="web", port=port)
        stage.spec.put(SPEC)
        stage.steps([make_step(seq) for seq in range(60)], last=True)
        stage.service.close()
    (event,) = stage.events()
    assert event.level == "WARN"
    assert event.text == f"recorder.port = {port}: Address already in use; no live view, the file is recorded"
    assert len(reading.columns(stage.path, "/env/reward")[0]) == 60


def test_without_a_viewer_nothing_is_dropped_and_the_file_has_each_row_once(tmp_path: Path) -> None:
    stage = set_stage(tmp_path, view="web", port=free_port())
    stage.spec.put(SPEC)
    stage.steps([make_step(seq) for seq in range(200)], last=True)
    stage.service.close()
    assert stage.events() == []
    assert stage.ledger.counter("live_dropped") == 0
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == list(range(200))


def test_a_viewer_that_comes_late_gets_what_there_was_and_what_follows(tmp_path: Path) -> None:
    port, seen = free_port(), tmp_path / "seen.rrd"
    stage = set_stage(tmp_path, view="native", port=port)
    stage.spec.put(SPEC)
    stage.steps([make_step(seq) for seq in range(100)])
    with viewer(port, seen):
        stage.steps([make_step(seq) for seq in range(100, 200)])
        stage.service.flush()
        until(lambda: len(readable(seen)) == 200)
    stage.service.close()
    assert readable(seen) == list(range(200))
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == list(range(200))


def readable(path: Path) -> list[int]:
    """Ticks in a file that is being written; none while its end is torn."""
    try:
        ticks: list[int] = reading.columns(path, "/env/reward")[0].tolist()
    except RuntimeError:
        return []
    return ticks


def test_a_stalled_viewer_is_dropped_for_a_while_and_the_file_goes_on(tmp_path: Path) -> None:
    port, clock = free_port(), MonotonicClock()
    file = RecordingFile(tmp_path / "recording.rrd", tmp_path / "place", clock)
    recording = open_recording(file, "r1", clock, port)
    live = recording.live
    assert live is not None
    recording.write(table(0))
    with viewer(port, tmp_path / "seen.rrd") as process:
        assert live.pump()
        os.kill(process, signal.SIGSTOP)
        # Behind the file's back, so that 200 MB go into the viewer's buffers and not onto the disk.
        stream = recording._streams[1]
        fill = table(1, rows=1000, series=200)
        longest = 0.0
        for _ in range(1000):
            stream.send_columns("/fill", time_columns(fill.index), payload_columns(fill.payload))
            begin = time.monotonic()
            kept_up = live.pump()
            longest = max(longest, time.monotonic() - begin)
            if not kept_up:
                break
        assert live.stalled
        assert longest < FLUSH_S + 0.2  # never waited for; generous, for a loaded machine
        begin = time.monotonic()
        for number in range(1, 101):
            recording.write(table(number))
            assert recording.sync(Place())
            assert live.pump()
        assert live.dropped == 1000
        os.kill(process, signal.SIGCONT)
        recording.close()
        assert time.monotonic() - begin < 2.0
    assert reading.columns(tmp_path / "recording.rrd", "/x")[0].tolist() == list(range(1010))


def test_a_stall_is_told_once(tmp_path: Path) -> None:
    stage = set_stage(tmp_path, view="web", port=free_port())
    stage.spec.put(SPEC)
    stage.service.poll()
    assert stage.service._recording is not None
    live = stage.service._recording.live
    assert live is not None

    class Stalled:
        """A stream whose viewer takes nothing."""

        def send_columns(self, *_: object, **__: object) -> None: ...

        def disconnect(self) -> None: ...

        def flush(self, *, timeout_sec: float) -> None:
            raise RuntimeError(f"not flushed within {timeout_sec} s")

    live._stream = Stalled()  # type: ignore[assignment]
    stage.steps([make_step(seq) for seq in range(1000)], last=True)  # 20 s: stalls anew every 5 s
    assert [event.text for event in stage.events()] == [
        "the live view does not keep up: it skips rows, the file has them"
    ]
    dropped = stage.ledger.counter("live_dropped")
    assert 0 < dropped < stage.ledger.counter("rows")
    stage.service.close()
