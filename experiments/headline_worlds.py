"""Worlds and chance of the headline experiment: many lanes, each with a phase (or an MDP) of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from env_server.worlds.mdp import chain_ends, random_ends
from learner.theory import values
from rtcore.config import MdpConfig

GAMMA = 0.9
UNITS, BURN = 800, 80  # T, and how many of its first units do not count
EPISODE_STEPS = 40  # H of the one trajectory per unit
LEVEL = 0.5  # of the wave where nothing drifts: one end of the chain pays 0.75, the other 0.25

Floats = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Setting:
    """What is lived in, and how fast the policy is.

    Attributes:
        world: "chain": five states, either end pays by turns; "random": six states, three actions, random
            P, and each R(s, a) swings with a phase of its own.
        period: of the swing, in units; None: stationary.
        eta: learning rate of the policy.
        slip: chain: probability of a step the other way.
    """

    world: Literal["chain", "random"] = "chain"
    period: float | None = 160.0
    eta: float = 0.2
    slip: float = 0.0

    def __str__(self) -> str:
        drift = "stationary" if self.period is None else f"period {self.period:g}"
        slip = f", slip {self.slip:g}" if self.world == "chain" else ""
        return f"{self.world}{slip}, {drift}, eta {self.eta:g}"


@dataclass(frozen=True)
class Worlds:
    """One time-elapsing MDP per lane.

    Attributes:
        reward: R_t(s, a), [T, n, S, A], in [0, 1].
        transition: P(s'|s, a), [n, S, A, S].
        start: distribution of the state that regret is counted from, [S]. Data is from every state.
    """

    reward: Floats
    transition: Floats
    start: Floats

    def optimal(self) -> values.Values:
        """Q*_t and V*_t, exactly, [T, n, S, A] and [T, n, S]."""
        return values.optimal(self.reward, self.transition, gamma=GAMMA)

    def lived(self, policy: Floats) -> Floats:
        """V^{pi_t}_t from `start`, exactly, [u, n], of pi_t(a|s) in the first u units, [u, n, S, A]."""
        reward = self.reward[: len(policy)]
        value: Floats = values.evaluate(reward, self.transition, policy, gamma=GAMMA).v @ self.start
        return value


@dataclass(frozen=True)
class Luck:
    """What is random in the data, drawn beforehand and the same for every arm; uniform in [0, 1).

    Attributes:
        start: [T, n], of the first state of the unit's trajectory.
        action: [T, H, n].
        move: [T, H, n], of the next state.
    """

    start: Floats
    action: Floats
    move: Floats

    @classmethod
    def draw(cls, seeds: Sequence[int], units: int = UNITS) -> Luck:
        """A lane's numbers do not depend on the other lanes."""
        streams = [np.random.default_rng((seed, 1)) for seed in seeds]
        shape = (units, EPISODE_STEPS)
        start = np.stack([stream.random(units) for stream in streams], -1)
        action = np.stack([stream.random(shape) for stream in streams], -1)
        return cls(start, action, np.stack([stream.random(shape) for stream in streams], -1))


def make_worlds(setting: Setting, seeds: Sequence[int], units: int = UNITS) -> Worlds:
    """A lane per seed, which decides its phases and, of a random world, its P."""
    return _chains(setting, seeds, units) if setting.world == "chain" else _random(setting, seeds, units)


def _chains(setting: Setting, seeds: Sequence[int], units: int) -> Worlds:
    """R(first, .) = (1 + s_t) / 2 and R(last, .) = (1 - s_t) / 2; regret from the state in the middle."""
    config = MdpConfig(states=5, slip=setting.slip)
    last, first = chain_ends(config)
    phase = _phases(seeds, ())
    wave = (
        np.full((units, len(seeds)), LEVEL) if setting.period is None else _wave(setting.period, phase, units)
    )
    weight = (1 + wave[..., None, None]) / 2
    reward = last.reward + weight * (first.reward - last.reward)
    transition = np.broadcast_to(last.transition, (len(seeds), *last.transition.shape))
    return Worlds(reward, transition, np.eye(config.states)[config.states // 2])


def _random(setting: Setting, seeds: Sequence[int], units: int) -> Worlds:
    """R(s, a) = (1 + sin) / 2 with a phase per (s, a), or what that is in unit 0; regret from any state."""
    config = MdpConfig(states=6, actions=3, concentration=0.3)
    phase = _phases(seeds, (config.states, config.actions))
    wave = (
        np.broadcast_to(np.sin(phase), (units, *phase.shape))
        if setting.period is None
        else _wave(setting.period, phase, units)
    )
    transition = np.stack([random_ends(config, seed)[0].transition for seed in seeds])
    return Worlds((1 + wave) / 2, transition, np.full(config.states, 1 / config.states))


def _phases(seeds: Sequence[int], shape: tuple[int, ...]) -> Floats:
    """Uniform in [0, 2 pi), [n, *shape], from a stream that the data's chance does not share."""
    drawn = [np.random.default_rng((seed, 2)).uniform(0, 2 * math.pi, shape) for seed in seeds]
    return np.asarray(drawn, np.float64)


def _wave(period: float, phase: Floats, units: int) -> Floats:
    time = np.arange(units).reshape(-1, *[1] * phase.ndim)
    wave: Floats = np.sin(2 * math.pi * time / period + phase)
    return wave
