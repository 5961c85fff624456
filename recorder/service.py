"""The recorder's loop: take what the others say, and write it down in chunks.

A chunk costs 50-70 us and 2 kB of its own per entity, a row 2 us (measured): so rows wait for each
other for half a second to a second. A kill -9 loses none of the steps: a later life takes them from the env
server's log; of the rest it loses what was said in that second and until the recorder is back.
"""

from __future__ import annotations

from typing import Literal

from recorder.disk import RecordingFile
from recorder.finish import FinishError, finish
from recorder.grid import GridScene
from recorder.intake import Intake
from recorder.place import Place
from recorder.scene import MujocoScene, PointScene, Scene
from recorder.sinks import Recording, open_recording
from recorder.telemetry import TelemetryRows
from recorder.writer import RunWriter
from rtcore.bus import Bus
from rtcore.clock import Clock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Command, CommandReply, Spec, Step
from rtcore.run_dir import RunDir

POLL_S = 0.05
DRAIN_NS = 2_000_000_000  # after the stop: so long at most for the others' last words
CHUNK_ROWS = 50  # the knee of cost per row
MIN_AGE_NS = 500_000_000  # a chunk of so many rows waits at least so long ...
MAX_AGE_NS = 1_000_000_000  # ... and a smaller one at most so long
MAX_ROWS = 2_000
PLACE_NAME = "recorder.place"
# The file is complete without being compacted, so compaction may take only what an end has to spare:
# whoever interrupts waits 5 s for all of it, at most 2 of them for the others' last words.
COMPACT_S = 10.0
COMPACT_INTERRUPTED_S = 1.5
LAST_S_NS = 1_000_000_000  # a step in the last second of the duration: nobody interrupted


class RecorderService:
    """Writes `recording.rrd` of one run. In virtual time the driver calls `poll`, in a process `run` does.

    It goes on where an earlier life of it was killed; `recorder.finish` then joins what they wrote.

    Counts `rows` (written to the file), `dropped` (steps that never came, other messages lost to a full
    queue, and rows that the disk did not take; those alone are `disk_dropped`) and `live_dropped` (rows that
    the live stream shed; the file has them).
    """

    def __init__(self, config: RunConfig, run_dir: RunDir, bus: Bus, clock: Clock, ledger: Ledger) -> None:
        self._config = config
        self._run_dir = run_dir
        self._clock = clock
        self._ledger = ledger
        self._telemetry = TelemetryRows()
        self._intake = Intake(bus, config.env.name, self._telemetry)
        self._recording: Recording | None = None
        self._writer: RunWriter | None = None
        self._steps: list[Step] = []
        self._oldest_ns: int | None = None  # when the oldest row that waits came in
        self._newest_ns = 0  # deadline of the newest step
        self._due_end_ns: int | None = None  # when the run is to end
        self._stall_told = self._place_told = False
        self._trouble_told = False  # the last word on the disk was that it takes nothing
        self._dropped_told = 0  # when it began to
        self._gaps_told = 0
        self._closed = False

    def run(self, stop: Stop) -> None:
        """Record until stopped, then until everybody has said the last word, at most 2 s."""
        while not stop.wait(POLL_S):
            self.poll()
        deadline_ns = self._clock.now_ns() + DRAIN_NS
        while not self._intake.complete and self._clock.now_ns() < deadline_ns:
            self._intake.wait(POLL_S)
            self.poll()

    def poll(self) -> None:
        """Take in what has come; write it when there is enough of it, or when it has waited enough."""
        recording = self._open()
        spec = self._intake.take_spec()
        if spec is not None and self._writer is None:
            self._writer = self._begin(recording, spec)
            if self._config.duration_s:
                self._due_end_ns = spec.t0_ns + round(self._config.duration_s * 1e9)
        now_ns = self._clock.now_ns()
        self._ledger.beat(now_ns)
        self._steps += self._intake.take_steps(now_ns)
        if self._steps:
            self._newest_ns = self._steps[-1].due_ns
        news = self._intake.take_telemetry()
        if self._oldest_ns is None and (self._steps or news):
            self._oldest_ns = now_ns
        if self._oldest_ns is not None:
            age_ns = now_ns - self._oldest_ns
            enough = len(self._steps) >= CHUNK_ROWS and age_ns >= MIN_AGE_NS
            if enough or age_ns >= MAX_AGE_NS or len(self._steps) >= MAX_ROWS:
                self.flush()

    def flush(self) -> None:
        """Write all that has been taken in."""
        if self._writer is None or self._recording is None:
            return
        self._writer.write(self._steps, self._telemetry, self._intake.placements)
        self._steps = []
        self._oldest_ns = None
        self._sync(self._recording, self._writer.place(self._intake.position, self._telemetry.told))
        live = self._recording.live
        if live is not None and not live.pump() and not self._stall_told:
            self._stall_told = True
            self._say("WARN", "the live view does not keep up: it skips rows, the file has them")
        self._account(self._recording)

    def close(self) -> None:
        """Write the rest, end the file, then compact and verify it. A second close does nothing."""
        if self._closed:
            return
        self._closed = True
        recording = self._open()
        self.poll()
        self._steps += self._intake.give_up_on_gaps()
        recording.file.insist()
        self.flush()
        if self._writer is None:
            self._sync(recording, recording.file.place)
            if recording.file.part is None:
                self._say("WARN", "no env server ever declared itself: the recording is empty")
        recording.close()
        self._account(recording)
        done = self._due_end_ns is not None and self._newest_ns >= self._due_end_ns - LAST_S_NS
        try:
            finish(self._run_dir.recording_path, timeout_s=COMPACT_S if done else COMPACT_INTERRUPTED_S)
        except FinishError as error:
            less = recording.dropped or recording.file.trouble
            what = "has what the disk took, and" if less else "is complete but"
            self._say("WARN", f"the recording {what} stays as it was written: {error}")

    def command(self, command: Command) -> CommandReply:
        """Answer an operator; called on the bus's thread."""
        if command.verb != "status":
            return CommandReply(id=command.id, ok=False, text=f"the recorder knows no '{command.verb}'")
        rows, dropped = self._ledger.counter("rows"), self._ledger.counter("dropped")
        return CommandReply(id=command.id, ok=True, text=f"{rows} rows written, {dropped} dropped")

    def _open(self) -> Recording:
        if self._recording is None:
            run_dir, run = self._run_dir, self._run_dir.run_name
            file = RecordingFile(run_dir.recording_path, run_dir.logs_dir / PLACE_NAME, self._clock)
            file.resume()
            self._intake.go_on_from(file.place)
            self._telemetry.go_on_from(file.place.told)
            settings = self._config.recorder
            port = None if settings.view == "none" else settings.port
            try:
                self._recording = open_recording(file, run, self._clock, port)
            except OSError as error:
                self._say(
                    "WARN", f"recorder.port = {port}: {error.strerror}; no live view, the file is recorded"
                )
                self._recording = open_recording(file, run, self._clock)
            self._sync(self._recording, file.place)
        return self._recording

    def _sync(self, recording: Recording, place: Place) -> None:
        """Have the file take what was written, and say what changed about the disk."""
        file, part = recording.file, recording.file.part
        if not recording.sync(place):
            self._say("WARN", "the recording is encoded more slowly than it is written")
        if file.part != part and file.part is not None:
            self._say(
                "INFO", f"goes on with a recording; what there was is in {file.part.name} until the end"
            )
        if file.unplaced and not self._place_told:
            self._place_told = True
            self._say(
                "WARN", f"rows may come twice if the recorder is killed: no place is kept: {file.unplaced}"
            )
        if file.trouble and not self._trouble_told:
            self._trouble_told = True
            self._say("WARN", f"the disk takes no rows: {file.trouble}; they are dropped and counted")
        elif self._trouble_told and not file.trouble:
            self._trouble_told = False
            dropped = recording.dropped - self._dropped_told
            self._dropped_told = recording.dropped
            self._say("WARN", f"the disk takes rows again; {dropped} were dropped")

    def _begin(self, recording: Recording, spec: Spec) -> RunWriter:
        scene = self._scene(spec) if self._config.recorder.detail == "full" else None
        place = recording.file.place
        return RunWriter(self._config, self._run_dir.run_name, recording, spec, scene, place)

    def _scene(self, spec: Spec) -> Scene | None:
        if spec.scene == "point":
            return PointScene()
        if spec.scene not in ("mujoco", "grid"):
            return None
        try:
            path = self._run_dir.world_path
            return MujocoScene.load(path) if spec.scene == "mujoco" else GridScene.load(path)
        except (OSError, ValueError) as error:
            self._say("WARN", f"no 3-D view: {error}")
            return None

    def _account(self, recording: Recording) -> None:
        self._ledger.set_counter("rows", recording.rows)
        self._ledger.set_counter("dropped", self._intake.dropped + recording.dropped)
        self._ledger.set_counter("disk_dropped", recording.dropped)
        self._ledger.set_counter("live_dropped", recording.live.dropped if recording.live else 0)
        lost = self._intake.gaps - self._gaps_told
        if lost:
            self._gaps_told += lost
            self._say("WARN", f"{lost} steps never came: their ticks are missing from the recording")

    def _say(self, level: Literal["INFO", "WARN"], text: str) -> None:
        self._ledger.event(self._clock.now_ns(), level, text)
