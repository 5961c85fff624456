"""A world whose every number is known, and an agent that does as it is told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from env_server.worlds.world import Outcome, Position, Vector
from rtcore import channels
from rtcore.bus import Bus
from rtcore.clock import VirtualClock
from rtcore.messages import Action, Step


class ScriptedWorld:
    """Observation [ticks since the reset, last action]; reward t, the unit; drift 10 t.

    Attributes:
        seeds: of the resets so far.
        acted: the actions so far.
        on_step: called in each step with the number of steps so far.
    """

    states = actions = 0
    observation_dim = 2
    action_dim = 1
    native_period_s: float | None = 0.05
    physics_step_s: float | None = 0.05
    scene = "point"

    def __init__(self, *, ends_at: int = 0, breaks_at: int = 0) -> None:
        """`ends_at`: step of each episode that terminates; `breaks_at`: step of the run that gives NaN."""
        self.action_low: Vector = np.array([-1.0], np.float32)
        self.action_high: Vector = np.array([1.0], np.float32)
        self.seeds: list[int | None] = []
        self.acted: list[float] = []
        self.on_step: Callable[[int], None] = lambda _: None
        self._ends_at = ends_at
        self._breaks_at = breaks_at
        self._ticks = 0

    def reset(self, seed: int | None, _t: int, /) -> Vector:
        self.seeds.append(seed)
        self._ticks = 0
        return np.array([0.0, 0.0], np.float32)

    def step(self, action: Vector, t: int, /) -> Outcome:
        self._ticks += 1
        self.acted.append(float(action[0]))
        self.on_step(len(self.acted))
        first = np.nan if len(self.acted) == self._breaks_at else self._ticks
        terminated = self._ticks == self._ends_at
        observation = np.array([first, action[0]], np.float32)
        return Outcome(observation, float(t), terminated, truncated=False, drift=self.drift(t))

    def drift(self, t: int, /) -> float:
        return 10.0 * t

    def physics(self, _t: int, /) -> tuple[float, ...]:
        return ()

    def position(self) -> Position:
        return np.array([float(self._ticks)])

    def save_scene(self, path: Path, /) -> None:
        pass

    def close(self) -> None:
        pass


class ScriptedAgent:
    """Answers each step with a value that tells its tick, unless told otherwise."""

    def __init__(self, bus: Bus, clock: VirtualClock) -> None:
        self._clock = clock
        self._steps = bus.latest(channels.STEP, "env0")
        self._actions = bus.publisher(channels.ACTION, "env0")

    def newest(self) -> Step:
        received = self._steps.take()
        assert received is not None
        return received.message

    def answer(
        self, step: Step, *, value: float | None = None, tick: int | None = None, **stamps: int
    ) -> None:
        """`stamps` are fields of `Action`; without them it took 300 ns."""
        values = np.array([step.tick / 1000 if value is None else value], np.float32)
        now_ns = self._clock.now_ns()
        answer = Action(
            env="env0", incarnation=step.incarnation, tick=step.tick if tick is None else tick,
            values=values.tobytes(), policy_version=5, received_ns=now_ns - 300, sent_ns=now_ns,
        )  # fmt: skip
        self._actions.put(msgspec.structs.replace(answer, **stamps))
