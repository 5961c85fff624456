"""Small finite MDPs that elapse with time and whose variation budgets are known exactly.

A time-elapsing MDP (paper, section 3) keeps its states and actions, while R_t and P_t depend on the unit t.
Here both lie on the line between two ends:

    R_t = (1 - w_t) R_A + w_t R_B,    P_t = (1 - w_t) P_A + w_t P_B,    w_t in [0, 1] from the drift's value

so whatever theory says about them can be checked against numbers.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from env_server.worlds.finite import FiniteWorld, Floats, Tables
from rtcore.config import ConfigError, MdpConfig

_STREAM = 1  # of the run's seed: what is drawn from it must not depend on how the steps are drawn
LEFT, RIGHT = 0, 1
MOST_PROBABILITIES = 1_000_000  # 8 MB a table, and one is made whenever the drift moves


def random_ends(config: MdpConfig, seed: int) -> tuple[Tables, Tables]:
    """A and B: rows of P from Dirichlet(concentration, ...), R uniform in [0, 1].

    What does not drift is the same in both. A does not depend on what drifts.

    Raises:
        ConfigError: the tables would be too large.
    """
    _check_size(config.states, config.actions)
    random = np.random.default_rng((seed, _STREAM))
    a, b = _random_tables(config, random), _random_tables(config, random)
    reward = a.reward if config.drifting == "dynamics" else b.reward
    transition = a.transition if config.drifting == "reward" else b.transition
    return a, Tables(reward, transition)


def chain_ends(config: MdpConfig) -> tuple[Tables, Tables]:
    """A row of states with a reward for leaving its first in B, and its last in A. No other reward.

    Action 0 goes left and 1 right, with probability `slip` the other way; the ends of the row are walls.

    Raises:
        ConfigError: the tables would be too large.
    """
    _check_size(config.states, 2)
    states = np.arange(config.states)
    transition = np.zeros((config.states, 2, config.states))
    for action, other in ((LEFT, RIGHT), (RIGHT, LEFT)):
        for direction, probability in ((action, 1 - config.slip), (other, config.slip)):
            following = np.clip(states + (1 if direction == RIGHT else -1), 0, config.states - 1)
            transition[states, action, following] += probability
    last, first = np.zeros((config.states, 2)), np.zeros((config.states, 2))
    last[-1] = first[0] = 1.0
    return Tables(last, transition), Tables(first, transition)


class DriftingMdp(FiniteWorld):
    """A world between two ends. Episodes begin anywhere, uniformly, and have no end of their own."""

    def __init__(
        self,
        ends: tuple[Tables, Tables],
        weight: Callable[[float], float],
        drift: Callable[[int], float],
        *,
        seed: int,
    ) -> None:
        """`weight` turns the drift's value into w, in [0, 1]; starts and steps are drawn from `seed`."""
        states, actions = ends[0].reward.shape
        super().__init__(states=states, actions=actions, drift=drift, seed=seed)
        self._ends = ends
        self._weight = weight
        self._now: tuple[float, Tables, Floats] | None = None  # drift, its tables, P summed along each row

    def tables(self, t: int) -> Tables:
        """R_t and P_t, exactly."""
        return self._at(self.drift(t))

    def budgets(self, units: int) -> tuple[Floats, Floats]:
        """The local variation budgets of the first `units` units (paper, section 3), exactly.

        Returns:
            b_r[t] = max over (s, a) of |R_{t+1} - R_t|, and b_p[t] = max over (s, a) of
            ||P_{t+1}(. | s, a) - P_t(. | s, a)||_1, for t = 0 .. units - 1; float64 [units] each.
        """
        found = np.zeros((2, units))
        now = self.tables(0)
        for t in range(units):
            then = self.tables(t + 1)
            found[0, t] = np.abs(then.reward - now.reward).max()
            found[1, t] = np.abs(then.transition - now.transition).sum(axis=-1).max()
            now = then
        return found[0], found[1]

    def starts(self) -> Floats:
        """Any state, one as likely as the other."""
        return np.full(self.states, 1.0 / self.states)

    def start(self, _drift: float) -> int:
        """Any state."""
        return int(self.random.integers(self.states))

    def transition(self, state: int, action: int, drift: float) -> tuple[int, float, bool]:
        """Draw the next state from P_t; the reward is R_t(s, a)."""
        if self._now is None or self._now[0] != drift:
            tables = self._at(drift)
            self._now = drift, tables, tables.transition.cumsum(axis=-1)
        _, tables, summed = self._now
        row = summed[state, action]
        # Scaled by the row's own sum, which rounding leaves a little off 1: a state of probability 0 is
        # never drawn, and the last one's share is not lost.
        following = int(np.searchsorted(row, self.random.random() * row[-1], side="right"))
        return following, float(tables.reward[state, action]), False

    def _at(self, drift: float) -> Tables:
        a, b = self._ends
        return a.towards(b, self._weight(drift))


class RandomMdp(DriftingMdp):
    """The `random_mdp` world: w is the drift's value clipped to [0, 1]."""

    def __init__(self, drift: Callable[[int], float], config: MdpConfig, *, seed: int) -> None:
        """Both ends are drawn from `seed`, on a stream of their own, once: reset(seed) does not change them.

        Raises:
            ConfigError: too many states.
        """
        super().__init__(
            random_ends(config, seed), lambda value: float(np.clip(value, 0.0, 1.0)), drift, seed=seed
        )


class Chain(DriftingMdp):
    """The `chain` world: with s the drift's value clipped to [-1, 1], leaving the first state earns
    (1 + s) / 2 and leaving the last one (1 - s) / 2."""

    def __init__(self, drift: Callable[[int], float], config: MdpConfig, *, seed: int) -> None:
        """Of `config` only `states` and `slip` count.

        Raises:
            ConfigError: too many states.
        """
        super().__init__(
            chain_ends(config), lambda value: (1 + float(np.clip(value, -1.0, 1.0))) / 2, drift, seed=seed
        )


def _random_tables(config: MdpConfig, random: np.random.Generator) -> Tables:
    reward = random.uniform(size=(config.states, config.actions))
    rows = random.dirichlet(np.full(config.states, config.concentration), reward.shape)
    return Tables(reward, rows)


def _check_size(states: int, actions: int) -> None:
    if states * states * actions > MOST_PROBABILITIES:
        allowed = f"with {actions} actions, P would have more than {MOST_PROBABILITIES:,} entries"
        raise ConfigError("env.mdp.states", states, allowed)
