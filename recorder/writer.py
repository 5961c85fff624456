"""From what came in to what is written: a run's entities, and the card, looks and layout around them."""

from __future__ import annotations

from collections.abc import Mapping

import rerun as rr

from recorder.card import run_card
from recorder.dashboard import dashboard
from recorder.env_writer import EnvWriter
from recorder.fleet_dashboard import fleet_dashboard
from recorder.place import START, EnvPlace, Place, Told
from recorder.rows import Rows, Timeline, roots
from recorder.scene import Scene
from recorder.sinks import Recording
from recorder.styling import env_looks, fleet_looks, forecast_look, learner_looks, looks
from recorder.telemetry import FORECAST, TelemetryRows
from recorder.ticks import speed_per_m
from rtcore.config import RunConfig
from rtcore.messages import Spec, Step

NOWHERE = Place()


class RunWriter:
    """Writes steps and telemetry of a run whose world is known; says first how everything looks.

    `spec` is of the environment that declared itself first. Each is written of once it has: see `begin`.
    `place` is where an earlier life of the recorder ended; its rows are in a file of their own.
    """

    def __init__(
        self,
        config: RunConfig,
        run: str,
        recording: Recording,
        spec: Spec,
        scene: Scene | None,
        place: Place = NOWHERE,
    ) -> None:
        self._config = config
        self._run = run
        self._recording = recording
        self._spec = spec
        self._scene = scene
        self._speed_per_m = speed_per_m(spec, config.env)
        self._roots = roots(config.env)
        self._envs: dict[str, EnvWriter] = {}
        self._places = dict(place.envs)  # of those that are not written of, too: a later life may
        self._placements: dict[str, str] | None = None  # as the run card has them
        self._forecast_names: list[str] = []
        self._looks = learner_looks(fleet=len(self._roots) > 1)  # of entities without rows yet
        self._introduce()

    def begin(self, env: str, spec: Spec) -> None:
        """Write of this environment from now on. A second call, of a later incarnation, does nothing."""
        if env in self._envs:
            return
        is_speed = self._speed_per_m is not None
        own = env_looks(drift_is_speed=is_speed)
        if len(self._roots) > 1:
            own = fleet_looks(env, list(self._roots).index(env), drift_is_speed=is_speed)
        self._envs[env] = EnvWriter(
            self._recording,
            self._roots[env],
            spec,
            self._speed_per_m,
            self._scene,
            own,
            self._places.get(env, START),
        )

    @property
    def begun(self) -> frozenset[str]:
        """The environments that have declared themselves."""
        return frozenset(self._envs)

    def write(self, env: str, steps: list[Step]) -> None:
        """Write rows of consecutive steps of an environment that has begun."""
        self._envs[env].write(steps)

    def tell(self, telemetry: TelemetryRows, placements: Mapping[str, str]) -> None:
        """Write rows of all else that came, after the steps: they say which episode it was."""
        if placements != self._placements:
            self._placements = dict(placements)
            card = run_card(self._run, self._config, self._spec, placements)
            self._recording.static("/run_card", rr.TextDocument(card, media_type="text/markdown"))
        shared, of_envs = self._timelines()
        tables = telemetry.rows(shared, of_envs)
        if telemetry.forecast_names != self._forecast_names:
            self._forecast_names = list(telemetry.forecast_names)
            self._recording.static(FORECAST, *looks(forecast_look(self._forecast_names)))
        for rows in tables:
            self._write(rows)

    def place(self, logs: Mapping[str, tuple[int, int] | None], told: Told) -> Place:
        """How far the recording has got, with all that was written; `logs` and `told` say what that was."""
        own: dict[str, EnvPlace] = {env: writer.place(logs.get(env)) for env, writer in self._envs.items()}
        return Place(self._places | own, self._placements or {}, told)

    def _timelines(self) -> tuple[Timeline, dict[int, Timeline]]:
        """Of what is no environment's own, that of the first one that is there; and by index all of them."""
        present = [(i, self._envs[env].timeline) for i, env in enumerate(self._roots) if env in self._envs]
        return (present[0][1] if present else Timeline(self._spec)), dict(present)

    def _write(self, rows: Rows) -> None:
        for archetype in self._looks.pop(rows.entity, []):
            self._recording.static(rows.entity, archetype)
        self._recording.write(rows)

    def _introduce(self) -> None:
        camera = self._scene.camera if self._scene else None
        spec, is_speed, fleet = self._spec, self._speed_per_m is not None, list(self._roots.values())
        self._recording.dashboard(
            lambda live: (
                dashboard(spec, camera, drift_is_speed=is_speed, live=live)
                if len(fleet) == 1
                else fleet_dashboard(spec, camera, fleet, drift_is_speed=is_speed, live=live)
            )
        )
        self._recording.start_time(spec.wall_t0_ns)
