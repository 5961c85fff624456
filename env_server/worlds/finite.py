"""What finite worlds share: numbered states and actions, and a random stream of their own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from env_server.worlds.world import Outcome, Position, Vector

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Tables:
    """One MDP, whole.

    Attributes:
        reward: float64 [S, A], earned on leaving state s by action a.
        transition: float64 [S, A, S], the probabilities of the next state; each row sums to 1.
    """

    reward: Floats
    transition: Floats

    def towards(self, other: Tables, weight: float) -> Tables:
        """The MDP on the line from this one (`weight` 0) to `other` (1)."""
        # In this form what is the same at both ends stays so to the last bit: it has a budget of 0.
        return Tables(
            self.reward + weight * (other.reward - self.reward),
            self.transition + weight * (other.transition - self.transition),
        )


class FiniteWorld(ABC):
    """A world whose observation is the state's number and whose action is the action's, one float32 each.

    An action between two numbers counts as the nearer one, and one outside as the nearest: 1.4 is action 1.

    Attributes:
        random: the stream behind `start` and `transition`; reset(seed) begins it anew.
    """

    observation_dim = action_dim = 1
    native_period_s: float | None = None
    physics_step_s: float | None = None
    scene = ""

    def __init__(self, *, states: int, actions: int, drift: Callable[[int], float], seed: int) -> None:
        """`drift` gives the drift's true value in unit t."""
        self.states = states
        self.actions = actions
        self.action_low: Vector = np.array([0.0], np.float32)
        self.action_high: Vector = np.array([actions - 1.0], np.float32)
        self.drift = drift
        self.random = np.random.default_rng(seed)
        self.state = 0

    @abstractmethod
    def tables(self, t: int) -> Tables:
        """R_t and P_t, exactly, so that values can be computed.

        Where an episode can end by itself, S is `states` + 1: the last state is the end, which nothing
        leaves and in which nothing is earned.
        """

    @abstractmethod
    def starts(self) -> Floats:
        """How likely an episode begins in each state, [S], with the S of `tables`."""

    @abstractmethod
    def start(self, drift: float) -> int:
        """The state that an episode begins in, given the drift's value."""

    @abstractmethod
    def transition(self, state: int, action: int, drift: float) -> tuple[int, float, bool]:
        """(next state, reward, terminated) of one step, given the drift's value over it."""

    def reset(self, seed: int | None, t: int, /) -> Vector:
        """Begin an episode in unit `t`."""
        if seed is not None:
            self.random = np.random.default_rng(seed)
        self.state = self.start(self.drift(t))
        return self._observe()

    def step(self, action: Vector, t: int, /) -> Outcome:
        """Take the action that `action` (float32 [1]) numbers."""
        number = int(np.clip(np.rint(action[0]), 0, self.actions - 1))
        drift = self.drift(t)
        self.state, reward, terminated = self.transition(self.state, number, drift)
        return Outcome(self._observe(), reward, terminated, truncated=False, drift=drift)

    def physics(self, _t: int, /) -> tuple[float, ...]:
        """There is none."""
        return ()

    def position(self) -> Position:
        """Nothing to draw."""
        return np.zeros(0)

    def save_scene(self, _path: Path, /) -> None:  # noqa: B027 (few have one)
        """No file is needed to draw it."""

    def close(self) -> None:  # noqa: B027 (plain arrays)
        """Nothing to free."""

    def _observe(self) -> Vector:
        return np.array([self.state], np.float32)
