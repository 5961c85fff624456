"""From one environment's steps to what is written of it: its entities below a root of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import rerun as rr

from recorder.place import EnvPlace
from recorder.rows import Rows, Timeline
from recorder.scene import Scene, drawn, drawn_every, positions
from recorder.sinks import Recording
from recorder.ticks import TickRows
from rtcore.messages import Spec, Step


class EnvWriter:
    """Writes the steps of an environment that has declared itself.

    Args:
        recording: they go there.
        root: where its entities lie: "", or of a fleet `/env2`.
        spec: its own.
        speed_per_m: see `TickRows`.
        scene: how the world is drawn, the same one for all of a fleet; None: it is not.
        looks: by entity below the root; each is said right before its first rows.
        place: where an earlier life of the recorder ended; its rows are in a file of their own.
    """

    def __init__(
        self,
        recording: Recording,
        root: str,
        spec: Spec,
        speed_per_m: float | None,
        scene: Scene | None,
        looks: Mapping[str, list[rr.AsComponents]],
        place: EnvPlace,
    ) -> None:
        self._recording = recording
        self._root = root
        self._scene = scene
        self._every = drawn_every(spec)
        self.timeline = Timeline(spec, place.episodes)
        self._ticks = TickRows(self.timeline, speed_per_m, place.carried)
        self._looks = dict(looks)  # of entities without rows yet
        for shape in scene.shapes() if scene is not None else ():
            recording.static(root + shape.entity, shape.archetype)

    def write(self, steps: list[Step]) -> None:
        """Write rows of consecutive steps; of none, nothing."""
        if not steps:
            return
        for rows in self._ticks.rows(steps):
            for archetype in self._looks.pop(rows.entity, ()):
                self._recording.static(self._root + rows.entity, archetype)
            self._recording.write(self._below(rows))
        if self._scene is not None and (shown := drawn(steps, self._every, self._scene)):
            index = self.timeline.of_steps(shown)
            for entity, poses in self._scene.poses(positions(shown)).items():
                self._recording.write(self._below(Rows(entity, index, poses)))

    def place(self, log: tuple[int, int] | None) -> EnvPlace:
        """How far the recording has got, with all that was written; `log` says what that was."""
        return EnvPlace(log, self._ticks.carried, self.timeline.episodes)

    def _below(self, rows: Rows) -> Rows:
        return replace(rows, entity=self._root + rows.entity) if self._root else rows
