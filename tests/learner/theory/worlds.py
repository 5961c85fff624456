"""Finite worlds to check the theory on."""

from __future__ import annotations

import numpy as np

from learner.tabular.table import log_normalised
from learner.theory import values
from learner.theory.certificates import Case
from learner.theory.mdp import Floats, TimeElapsingMdp


def bandit(rewards: list[list[float]]) -> TimeElapsingMdp:
    """One state, one step: rewards [T, A]."""
    reward = np.array(rewards, np.float64)[:, None, :]
    return TimeElapsingMdp(reward, np.ones((*reward.shape, 1)), 0.0)


def best_softened(world: TimeElapsingMdp, unit: int, tau: float) -> Floats:
    """Log pi*_tau of a unit."""
    reward, transition = world.reward[unit], world.transition[unit]
    return values.soft_optimal(reward, transition, gamma=world.gamma, tau=tau).log_policy


def best(world: TimeElapsingMdp, unit: int) -> Floats:
    """Q* of a unit, of infinite episodes."""
    return values.optimal(world.reward[unit], world.transition[unit], gamma=world.gamma).q


def random_world(rng: np.random.Generator, units: int) -> TimeElapsingMdp:
    """It stands still, drifts, jumps once or jumps about, between two random MDPs."""
    states, actions = int(rng.integers(1, 5)), int(rng.integers(2, 4))
    r = rng.normal(size=(2, states, actions)) * 10 ** rng.uniform(-1, 1)
    p = rng.dirichlet([0.3] * states, size=(2, states, actions))
    share = [
        np.zeros(units),
        np.linspace(0, 1, units),
        (np.arange(units) >= rng.integers(1, units)).astype(float),
        rng.random(units),
    ][rng.integers(4)]
    reward = r[0] + share[:, None, None] * (r[1] - r[0])
    transition = p[0] + share[:, None, None, None] * (p[1] - p[0])
    horizon = None if rng.random() < 0.7 else int(rng.integers(1, 30))
    return TimeElapsingMdp(reward, transition, float(rng.choice([0, 0.3, 0.6, 0.9, 0.95])), horizon)


def random_case(rng: np.random.Generator, world: TimeElapsingMdp) -> Case:
    """A window anywhere in the world, with a forecast that may be wrong and a policy that may be sure."""
    last = world.units - 1
    update = int(rng.integers(1, last + 1))
    hold = int(rng.integers(0, last - update + 1))
    begin = int(rng.integers(0, last - update - hold + 1))
    tau = 10 ** rng.uniform(-3, 0)
    shape = (world.states, world.actions)
    forecast = best(world, begin + update + hold) + rng.choice([0, 0.1, 1]) * rng.normal(size=shape)
    policy = log_normalised(rng.normal(size=shape) * 10 ** rng.uniform(-1, 2))
    if rng.random() < 0.3:
        policy = best_softened(world, begin, tau)
    eta = float(rng.choice([0.02, 0.1, 0.5, 1.0])) * (1 - world.gamma) / tau
    return Case(world, begin, update, hold, policy, forecast, eta, tau)
