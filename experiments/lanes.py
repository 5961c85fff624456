"""Tabular learners on the cliffworld, many lanes at once: a lane is one (alpha, epsilon) pair with one seed.

Each arm learns by the same Q-learning, one transition at a time, and differs in which table it acts on and
in what is written back. Arms share their lanes' random numbers, so that their differences are paired.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from env_server.worlds.cliffworld import MOVES, START, STATES, tables
from learner.forecast.forq import fit
from learner.tabular.table import greedy, q_update
from rtcore.config import CliffConfig, ForecastConfig

# (alpha, epsilon), as the paper's appendix lists them.
PAIRS = ((0.05, 0.05), (0.1, 0.1), (0.1, 0.05), (0.2, 0.1), (0.2, 0.05), (0.3, 0.1))
EPISODE_STEPS = 100  # the paper's "maximum number of steps"

Floats = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Reading:
    """One way to read what the paper leaves open."""

    cliff: CliffConfig
    gamma: float

    def __str__(self) -> str:
        cliff = self.cliff
        return f"{cliff.pays}, {cliff.inactive_goal}, {self.gamma:g}, {cliff.step_reward:g}"


@dataclass(frozen=True)
class Arm:
    """A learner.

    Attributes:
        acts: on Q itself, or on the forecast, made at an episode's end and frozen over the next.
        step_factor: times the pair's alpha.
        l_p: tables of the newest episodes' ends that the forecast is fitted to, in the identity basis.
        l_f: episodes that it looks ahead.
        write_back: share of the forecast that Q moves towards at an episode's end.
    """

    acts: Literal["live", "forecast"] = "live"
    step_factor: float = 1.0
    l_p: int = 1
    l_f: float = 1.0
    write_back: float = 0.0


@dataclass(frozen=True)
class Luck:
    """What is random, drawn beforehand; lane 6 i + j is seed i with pair j.

    Attributes:
        explore: [steps, L], whether the step's action is a random one.
        action: [steps, L], that action.
    """

    explore: Flags
    action: Index

    @classmethod
    def draw(cls, seeds: Sequence[int], steps: int) -> Luck:
        """A seed's numbers do not depend on the other seeds."""
        shape, epsilon = (steps, len(PAIRS)), [pair[1] for pair in PAIRS]
        streams = [np.random.default_rng(seed) for seed in seeds]
        explore = [stream.random(shape) < epsilon for stream in streams]
        action = [stream.integers(len(MOVES), size=shape) for stream in streams]
        return cls(np.concatenate(explore, 1), np.concatenate(action, 1))


@dataclass(frozen=True)
class Moment:
    """One step of every lane; each array is [L]. `q` [L, 36, 4] is the live table after it, not a copy."""

    state: Index
    action: Index
    reward: Floats
    next_state: Index
    terminated: Flags
    over: Flags  # the episode, ended or truncated
    q: Floats


def play(reading: Reading, arm: Arm, luck: Luck, *, switch: int, first: int = 0) -> Iterator[Moment]:
    """Live through the steps of `luck`; goal `first` is active before step `switch`, the other from it on.

    Q begins at 0, and of equal actions the first is taken: up, down, left, right.
    """
    worlds = tables(reading.cliff, first), tables(reading.cliff, 1 - first)
    lanes = luck.action.shape[1]
    alpha = arm.step_factor * np.tile([pair[0] for pair in PAIRS], lanes // len(PAIRS))
    q = np.zeros((lanes, STATES, len(MOVES)))
    past = _Past(arm, q)
    lane, state, age = np.arange(lanes), np.full(lanes, START), np.zeros(lanes, np.int64)
    acted_on = q if arm.acts == "live" else past.forecast
    for step, (explore, random_action) in enumerate(zip(luck.explore, luck.action, strict=True)):
        action = np.where(explore, random_action, greedy(acted_on[lane, state]))
        world, at = worlds[step >= switch], (state, action)
        reward, following, terminated = world.reward[at], world.next_state[at], world.terminated[at]
        q_update(q, state, action, reward, following, terminated, step_size=alpha, gamma=reading.gamma)
        age += 1
        over = terminated | (age == EPISODE_STEPS)
        if over.any():
            past.end_episode(np.flatnonzero(over))
        yield Moment(state, action, reward, following, terminated, over, q)
        state, age = np.where(over, START, following), np.where(over, 0, age)


class _Past:
    """The tables at the ends of past episodes, and the forecast from them; before there is one, Q at 0."""

    def __init__(self, arm: Arm, q: Floats) -> None:
        self._arm, self._q = arm, q
        self._tables = np.repeat(q[:, None], arm.l_p, axis=1)  # [L, l_p, S, A], newest last
        self._known = np.zeros(len(q), np.int64)  # how many of them
        self._weights = np.array([_weights(known, arm) for known in range(1, arm.l_p + 1)])
        self.forecast = q.copy()

    def end_episode(self, lane: Index) -> None:
        """The episodes of these lanes end: keep their tables, forecast, and write back."""
        arm, q, kept = self._arm, self._q, self._tables
        if arm.acts == "live" and not arm.write_back:
            return
        kept[lane, :-1] = kept[lane, 1:]
        kept[lane, -1] = q[lane]
        self._known[lane] = np.minimum(self._known[lane] + 1, arm.l_p)
        weights = self._weights[self._known[lane] - 1]
        self.forecast[lane] = (weights[:, :, None, None] * kept[lane]).sum(1)
        if arm.write_back:
            q[lane] += arm.write_back * (self.forecast[lane] - q[lane])
            kept[lane, -1] = q[lane]


def _weights(known: int, arm: Arm) -> Floats:
    """ForQ's, [l_p], for the newest `known` tables; 0 for the rest."""
    time_k = np.arange(1.0 - known, 1.0)
    weights = fit(ForecastConfig(basis="identity"), list(time_k), arm.l_f)
    return np.concatenate([np.zeros(arm.l_p - known), weights])
