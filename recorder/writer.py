"""From what came in to what is written: a run's entities, and the card, looks and layout around them."""

from __future__ import annotations

import rerun as rr

from recorder.card import run_card
from recorder.dashboard import dashboard
from recorder.place import Place, Told
from recorder.rows import Rows, Timeline
from recorder.scene import Scene, drawn, drawn_every, positions
from recorder.sinks import Recording
from recorder.styling import forecast_look, looks, static_looks
from recorder.telemetry import FORECAST, TelemetryRows
from recorder.ticks import TickRows, speed_per_m
from rtcore.config import RunConfig
from rtcore.messages import Spec, Step

START = Place()


class RunWriter:
    """Writes steps and telemetry of a run whose world is known; says first how everything looks.

    `place` is where an earlier life of the recorder ended; its rows are in a file of their own.
    """

    def __init__(
        self,
        config: RunConfig,
        run: str,
        recording: Recording,
        spec: Spec,
        scene: Scene | None,
        place: Place = START,
    ) -> None:
        self._config = config
        self._run = run
        self._recording = recording
        self._spec = spec
        self._scene = scene
        self._every = drawn_every(spec)
        self._timeline = Timeline(spec, place.episodes)
        scale = speed_per_m(spec, config.env)
        self._ticks = TickRows(self._timeline, scale, place.carried)
        self._placements: dict[str, str] | None = None  # as the run card has them
        self._forecast_names: list[str] = []
        self._looks = static_looks(drift_is_speed=scale is not None)  # of entities without rows yet
        self._introduce(drift_is_speed=scale is not None)

    def write(self, steps: list[Step], telemetry: TelemetryRows, placements: dict[str, str]) -> None:
        """Write rows of all that came."""
        if placements != self._placements:
            self._placements = dict(placements)
            card = run_card(self._run, self._config, self._spec, placements)
            self._recording.static("/run_card", rr.TextDocument(card, media_type="text/markdown"))
        if steps:
            for rows in self._ticks.rows(steps):
                self._write(rows)
            self._write_poses(steps)
        tables = telemetry.rows(self._timeline)
        if telemetry.forecast_names != self._forecast_names:
            self._forecast_names = list(telemetry.forecast_names)
            self._recording.static(FORECAST, *looks(forecast_look(self._forecast_names)))
        for rows in tables:
            self._write(rows)

    def place(self, log: tuple[int, int] | None, told: Told) -> Place:
        """How far the recording has got, with all that was written; `log` and `told` say what that was."""
        return Place(log, self._ticks.carried, self._timeline.episodes, self._placements or {}, told)

    def _write(self, rows: Rows) -> None:
        for archetype in self._looks.pop(rows.entity, []):
            self._recording.static(rows.entity, archetype)
        self._recording.write(rows)

    def _introduce(self, *, drift_is_speed: bool) -> None:
        camera = self._scene.camera if self._scene else None
        self._recording.dashboard(
            lambda live: dashboard(self._spec, camera, drift_is_speed=drift_is_speed, live=live)
        )
        self._recording.start_time(self._spec.wall_t0_ns)
        if self._scene is not None:
            for shape in self._scene.shapes():
                self._recording.static(shape.entity, shape.archetype)

    def _write_poses(self, steps: list[Step]) -> None:
        if self._scene is None:
            return
        shown = drawn(steps, self._every, self._scene)
        if shown:
            index = self._timeline.of_steps(shown)
            for entity, poses in self._scene.poses(positions(shown)).items():
                self._recording.write(Rows(entity, index, poses))
