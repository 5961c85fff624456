"""What a world is: the contract that every simulator adapter keeps.

A world knows nothing of clocks, episodes' length, buses or misses: it is stepped once per tick with
the action that acts, and told the unit t, which alone moves its drift.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float32]
Position = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one step brought.

    Attributes:
        observation: float32 [observation_dim] after the step; memory of its own.
        reward: earned over the step.
        terminated: the task ended, so the value of what follows is 0.
        truncated: the world itself cut the episode short for another reason; never with `terminated`.
        drift: the drift's true value over the step.
    """

    observation: Vector
    reward: float
    terminated: bool
    truncated: bool
    drift: float


class World(Protocol):
    """A simulated world, stepped by somebody else's clock.

    In a finite one states and actions are numbered: an observation is the state's number, an action its
    own, each as one float32.
    """

    @property
    def states(self) -> int:
        """How many there are; 0: observations are continuous."""

    @property
    def actions(self) -> int:
        """How many there are; 0: actions are continuous. Both are 0, or neither is."""

    @property
    def observation_dim(self) -> int:
        """Numbers in an observation."""

    @property
    def action_dim(self) -> int:
        """Numbers in an action."""

    @property
    def action_low(self) -> Vector:
        """float32 [action_dim], finite, in the world's own units."""

    @property
    def action_high(self) -> Vector:
        """float32 [action_dim], finite, each above `action_low`."""

    @property
    def native_period_s(self) -> float | None:
        """Simulated seconds per step as the world's authors meant it; None: it has no time scale."""

    @property
    def physics_step_s(self) -> float | None:
        """Simulated seconds per physics step; None: the period of a step cannot be chosen."""

    @property
    def scene(self) -> str:
        """How to draw it: "mujoco", "point", "grid" (see `save_scene`), or "" for not at all."""

    def reset(self, seed: int | None, t: int, /) -> Vector:
        """Begin an episode in unit `t`.

        The same seed gives the same episode; None goes on with the world's own random stream.

        Returns:
            float32 [observation_dim], memory of its own.
        """

    def step(self, action: Vector, t: int, /) -> Outcome:
        """Live through one tick under `action` (float32 [action_dim], within the bounds) in unit `t`."""

    def drift(self, t: int, /) -> float:
        """The drift's true value in unit `t`; 0 where nothing drifts."""

    def physics(self, t: int, /) -> tuple[float, ...]:
        """The factors on mass, friction and gravity in unit `t`; empty where none of them drifts."""

    def position(self) -> Position:
        """float64 coordinates for drawing (MuJoCo: qpos), a copy; empty where there is no scene."""

    def save_scene(self, path: Path, /) -> None:
        """Write what a viewer needs to draw `position`: with scene "mujoco" a model at `path`, with "grid" a
        board beside it (`rtcore.board`), else no file."""

    def close(self) -> None:
        """Free the simulator. A second close does nothing."""
