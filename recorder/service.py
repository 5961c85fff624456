"""The recorder's loop: take what the others say, and write it down in chunks.

A chunk costs 50-70 us and 2 kB of its own per entity, a row 2 us (measured): so rows wait for each
other for half a second to a second. A kill -9 loses none of the steps: a later life takes them from the env
server's log; of the rest it loses what was said in that second and until the recorder is back.

A fleet's environments are written together, each when all have enough rows: they are equally fast, so each
has its whole chunks, and what is said beside them is cut up no more than with one.
"""

from __future__ import annotations

from typing import Literal

from recorder.disk import RecordingFile
from recorder.finish import FinishError, files_of, finish
from recorder.grid import GridScene
from recorder.intake import Intake
from recorder.place import Place
from recorder.scene import MujocoScene, PointScene, Scene
from recorder.sinks import Recording, open_recording
from recorder.telemetry import TelemetryRows
from recorder.writer import RunWriter
from rtcore.bus import Bus
from rtcore.cast import env_names
from rtcore.clock import Clock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Command, CommandReply, Spec, Step
from rtcore.run_dir import RunDir

POLL_S = 0.05
DRAIN_NS = 2_000_000_000  # after the stop: so long at most for the others' last words
CHUNK_ROWS = 50  # the knee of cost per row; of each environment that has any
MIN_AGE_NS = 500_000_000  # a chunk of so many rows waits at least so long ...
MAX_AGE_NS = 1_000_000_000  # ... and a smaller one at most so long
MAX_ROWS = 2_000  # of one environment; more of them come after a restart, and are written so many by so many
PLACE_NAME = "recorder.place"
# The file has all rows without being compacted, so compaction may take only what an end has to spare:
# whoever interrupts waits 4.5 s for all of it, at most 2 of them for the others' last words.
COMPACT_S = 10.0
COMPACT_INTERRUPTED_S = 1.5
LAST_S_NS = 1_000_000_000  # a step in the last second of the duration: nobody interrupted


class RecorderService:
    """Writes `recording.rrd` of one run. In virtual time the driver calls `poll`, in a process `run` does.

    It goes on where an earlier life of it was killed; `recorder.finish` then joins what they wrote.

    Counts `rows` (written to the file), `dropped` (steps that never came, other messages lost to a full
    queue, and rows that the disk did not take; those alone are `disk_dropped`) and `live_dropped` (rows that
    the live stream shed; the file has them). In a fleet also `gaps.<env>`, steps that never came.
    """

    def __init__(self, config: RunConfig, run_dir: RunDir, bus: Bus, clock: Clock, ledger: Ledger) -> None:
        self._config = config
        self._run_dir = run_dir
        self._clock = clock
        self._ledger = ledger
        self._telemetry = TelemetryRows()
        self._envs = env_names(config.env)
        self._intake = Intake(bus, self._envs, self._telemetry)
        self._recording: Recording | None = None
        self._writer: RunWriter | None = None
        self._steps: dict[str, list[Step]] = {env: [] for env in self._envs}
        self._oldest_ns: int | None = None  # when the oldest row that waits came in
        self._newest_ns = 0  # deadline of the newest step of all
        self._due_end_ns: int | None = None  # when the run is to end
        self._stall_told = self._place_told = False
        self._trouble_told = False  # the last word on the disk was that it takes nothing
        self._dropped_told = 0  # when it began to
        self._gaps_told = dict.fromkeys(self._envs, 0)
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
        for env, spec in self._intake.take_specs().items():
            self._begin(recording, env, spec)
        for env in self._envs:  # after a restart each has a history that takes its time
            self._beat()
            self._keep(env, self._intake.take_steps(env, self._clock.now_ns()))
            if len(self._steps[env]) >= MAX_ROWS:
                self.flush()
        news = self._intake.take_telemetry()
        now_ns = self._clock.now_ns()
        waiting = [len(steps) for steps in self._steps.values() if steps]
        if self._oldest_ns is None and (waiting or news):
            self._oldest_ns = now_ns
        if self._oldest_ns is not None:
            age_ns = now_ns - self._oldest_ns
            enough = min(waiting, default=0) >= CHUNK_ROWS and age_ns >= MIN_AGE_NS
            if enough or age_ns >= MAX_AGE_NS:
                self.flush()

    def flush(self) -> None:
        """Write all that has been taken in, of the environments that have declared themselves."""
        if self._writer is None or self._recording is None:
            return
        for env in self._envs:
            if env in self._writer.begun:
                steps, self._steps[env] = self._steps[env], []
                for begin in range(0, len(steps), MAX_ROWS):
                    self._beat()
                    self._writer.write(env, steps[begin : begin + MAX_ROWS])
        self._beat()
        self._writer.tell(self._telemetry, self._intake.placements)
        self._oldest_ns = None
        self._sync(self._recording, self._writer.place(self._intake.positions, self._telemetry.told))
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
        for env, steps in self._intake.give_up_on_gaps().items():
            self._keep(env, steps)
        recording.file.insist()
        self.flush()
        if self._writer is None:
            self._sync(recording, recording.file.place)
            if recording.file.part is None:
                self._say("WARN", "no env server ever declared itself: the recording is empty")
        else:
            for env in self._envs:
                if env not in recording.file.place.envs:
                    self._say("WARN", f"{env} never declared itself: the recording has nothing of it")
        recording.close()
        self._account(recording)
        self._finish(recording)

    def command(self, command: Command) -> CommandReply:
        """Answer an operator; called on the bus's thread."""
        if command.verb != "status":
            return CommandReply(id=command.id, ok=False, text=f"the recorder knows no '{command.verb}'")
        rows, dropped = self._ledger.counter("rows"), self._ledger.counter("dropped")
        return CommandReply(id=command.id, ok=True, text=f"{rows} rows written, {dropped} dropped")

    def _finish(self, recording: Recording) -> None:
        """Compact what was written, or say where it lies and what to do."""
        done = self._due_end_ns is not None and self._newest_ns >= self._due_end_ns - LAST_S_NS
        path = self._run_dir.recording_path
        try:
            finish(path, timeout_s=COMPACT_S if done else COMPACT_INTERRUPTED_S)
        except FinishError as error:
            files = len(files_of(path))
            less = recording.dropped or recording.file.trouble
            has = "what the disk took" if less else "all rows"
            where = f"is in {files} files" if files > 1 else "stays as it was written"
            remedy = f"; to complete it: python -m recorder.finish {path}" if files else ""
            self._say("WARN", f"the recording has {has} but {where}: {error}{remedy}")

    def _open(self) -> Recording:
        if self._recording is None:
            run_dir, run = self._run_dir, self._run_dir.run_name
            place_path = run_dir.logs_dir / PLACE_NAME
            file = RecordingFile(run_dir.recording_path, place_path, self._clock, len(self._envs))
            file.resume()
            if file.unread:
                text = (
                    "the recording goes on, but how far it had got is not known: its last rows may come twice"
                )
                self._say("WARN", f"{text} ({PLACE_NAME}: {file.unread})")
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

    def _begin(self, recording: Recording, env: str, spec: Spec) -> None:
        """Write of an environment that has declared itself; with the first one the writing begins."""
        if self._writer is None:
            scene = self._scene(spec) if self._config.recorder.detail == "full" else None
            name, place = self._run_dir.run_name, recording.file.place
            self._writer = RunWriter(self._config, name, recording, spec, scene, place)
            if self._config.duration_s:
                self._due_end_ns = spec.t0_ns + round(self._config.duration_s * 1e9)
        self._writer.begin(env, spec)

    def _keep(self, env: str, steps: list[Step]) -> None:
        """Have steps wait until they are written."""
        self._steps[env] += steps
        if steps:
            self._newest_ns = max(self._newest_ns, steps[-1].due_ns)

    def _beat(self) -> None:
        self._ledger.beat(self._clock.now_ns())

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
        for env, gaps in self._intake.gaps.items():
            fleet = len(self._envs) > 1
            if fleet:
                self._ledger.set_counter(f"gaps.{env}", gaps)
            if lost := gaps - self._gaps_told[env]:
                self._gaps_told[env] = gaps
                text = f"{lost} steps never came: their ticks are missing from the recording"
                self._say("WARN", f"{env}: {text}" if fleet else text)

    def _say(self, level: Literal["INFO", "WARN"], text: str) -> None:
        self._ledger.event(self._clock.now_ns(), level, text)
