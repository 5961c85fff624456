"""Families of rewards that one number per unit, the drift's latent z, picks a member of.

The declared family is that of the worlds with a drifting target speed (paper, appendix, environments),
with z in the place of the target v_d(t):

    r(s', a; z) = healthy - |k_f v' - z| - control_cost |a|^2

v' is the speed in the observation after the step. The environment rewards the mean speed over the step:
the same in `pointmass` at its native period, an approximation in HalfCheetah and Swimmer. With delayed
actions, a is the one decided and not the one that was under way: the cost is an approximation then.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import State
from learner.deep.networks import Adam, FlatParameters
from learner.forecast.scalar import MEMORY, Series
from learner.replay import Batch, Columns, Floats
from rtcore.config import ConfigError, RewardConfig, RewardModelConfig
from rtcore.spaces import Spaces

Wide = NDArray[np.float64]


class RewardModel(Protocol):
    """A family of rewards, and the latents of the units so far.

    Attributes:
        residual: root mean square of the newest fit's errors, per tick.
    """

    residual: float

    def begin(self, unit: int) -> None:
        """There is a transition of `unit`. Until it is fitted, and if it never is, its latent is the one
        before. Units rise; those that are left out count as begun."""

    def learn(self) -> None:
        """Improve the family itself on what the replay holds, if it is learned."""

    def fit(self, seen: Columns) -> None:
        """The newest unit's latent, from its transitions so far: at least one."""

    def series(self, unit: int) -> Series:
        """Latents of the units up to `unit`, oldest first, the last 60; empty before the first one."""

    def rewards(self, batch: Batch, latent: float) -> Floats:
        """What the family pays for the transitions in `batch` under one latent, [B]."""

    def trained(self) -> dict[str, tuple[FlatParameters, Adam]]:
        """Networks, for the checkpoint."""

    def state(self) -> State:
        """The rest, for the checkpoint."""

    def expected(self, scalars: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """Tensors of the shapes that a `state` with these scalars has."""

    def load(self, state: State) -> None:
        """Go on from a `state`."""


class Latents:
    """One number per unit, from the unit `first` on. With `keep`, only the newest so many.

    Attributes:
        first: the unit of the oldest one; -1 before there is any.
        values: float64 [n].
    """

    def __init__(self, keep: int | None = None) -> None:
        self.first = -1
        self.values: Wide = np.zeros(0)
        self._keep = keep

    @property
    def newest(self) -> int:
        """The unit of the newest one; the one before `first` when there is none."""
        return self.first + len(self.values) - 1

    def begin(self, unit: int) -> int:
        """Repeat the newest latent (0 at first) up to `unit`; returns how many were added."""
        if not len(self.values):
            self.first, self.values = unit, np.zeros(1)
            return 1
        added = max(0, unit - self.newest)
        self.values = np.concatenate([self.values, np.full(added, self.values[-1])])
        if self._keep is not None:
            self.forget(self.newest + 1 - self._keep)
        return added

    def forget(self, unit: int) -> int:
        """Drop the latents of units before `unit`, but not the newest; returns how many were dropped."""
        dropped = min(max(0, unit - self.first), len(self.values) - 1)
        self.first, self.values = self.first + dropped, self.values[dropped:]
        return dropped

    def series(self, unit: int) -> Series:
        """See `RewardModel.series`."""
        end = max(0, unit + 1 - self.first) if len(self.values) else 0
        return self.values[:end][-MEMORY:]


class Declared:
    """The family of `env.reward`, whose weights are known; only z is not."""

    def __init__(self, config: RewardModelConfig, family: RewardConfig, spaces: Spaces) -> None:
        """
        Raises:
            ConfigError: the observation has no entry `speed_entry`.
        """
        if config.speed_entry >= spaces.observation_dim:
            allowed = f"must be below {spaces.observation_dim}, the numbers in an observation"
            raise ConfigError("learner.reward.speed_entry", config.speed_entry, allowed)
        self.residual = 0.0
        self._entry, self._family = config.speed_entry, family
        # the replay's actions are in [-1, 1], the cost is on those of the environment
        low, high = spaces.action_low or (-1.0,), spaces.action_high or (1.0,)
        self._middle, self._half_span = (np.add(high, low) / 2), (np.subtract(high, low) / 2)
        self._latents = Latents(keep=MEMORY)

    def begin(self, unit: int) -> None:
        """See `RewardModel`."""
        self._latents.begin(unit)

    def learn(self) -> None:
        """There is nothing to learn."""

    def fit(self, seen: Columns) -> None:
        """See `RewardModel`. The latent is the z of the least squared error.

            argmin_z sum_i (r_i - r(s'_i, a_i; z))^2 = argmin_z sum_i (|k_f v'_i - z| - m_i)^2

        with m = healthy - control_cost |a|^2 - r.
        """
        speed = self._speed(seen.next_observation)
        distance = self._family.healthy - self._cost(seen.action) - seen.reward.astype(np.float64)
        latent, mean_square = nearest_target(speed, distance)
        self._latents.values[-1], self.residual = latent, float(np.sqrt(mean_square))

    def series(self, unit: int) -> Series:
        """See `RewardModel`."""
        return self._latents.series(unit)

    def rewards(self, batch: Batch, latent: float) -> Floats:
        """See `RewardModel`."""
        miss = np.abs(self._speed(batch.next_observation) - latent)
        return (self._family.healthy - miss - self._cost(batch.action)).astype(np.float32)

    def _speed(self, next_observation: Floats) -> Wide:
        """k_f v', [B]."""
        return self._family.k_f * next_observation[:, self._entry].astype(np.float64)

    def _cost(self, action: Floats) -> Wide:
        """control_cost |a|^2 with a in the environment's units, [B]."""
        applied = self._middle + self._half_span * action
        return np.asarray(self._family.control_cost * np.square(applied).sum(-1))

    def trained(self) -> dict[str, tuple[FlatParameters, Adam]]:
        """None."""
        return {}

    def state(self) -> State:
        """See `RewardModel`."""
        latents = self._latents
        scalars = {"first": latents.first, "count": len(latents.values), "residual": self.residual}
        return State({"latents": latents.values.copy()}, scalars)

    def expected(self, scalars: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """See `RewardModel`."""
        return {"latents": np.zeros(scalars["count"])}

    def load(self, state: State) -> None:
        """See `RewardModel`."""
        self._latents.first = int(state.scalars["first"])
        self._latents.values = state.tensors["latents"].copy()
        self.residual = float(state.scalars["residual"])


def nearest_target(speed: Wide, distance: Wide) -> tuple[float, float]:
    """The z that minimises mean_i (|x_i - z| - m_i)^2, and the minimum; exact, in O(n log n).

    With the x_i sorted and z in [x_k, x_{k+1}], |x_i - z| = s_i (z - x_i) with s_i = 1 up to k and -1
    beyond, so that the sum is a parabola in z,

        sum_i (z - x_i - s_i m_i)^2 = n (z - c_k)^2 + sum_i (x_i + s_i m_i)^2 - n c_k^2,

    with c_k = mean_i (x_i + s_i m_i); its least value there is at c_k, moved into the interval. The best
    of the n + 1 intervals is the answer; of equals the lowest.

    Args:
        speed: x, [n], n >= 1.
        distance: m, [n]; negative where a reward is better than the family allows.
    """
    order = np.argsort(speed, kind="stable")
    x, m = speed[order], distance[order]
    n = len(x)
    below = np.concatenate([[0.0], np.cumsum(m)])  # sum of m up to k, k = 0 .. n
    below_xm = np.concatenate([[0.0], np.cumsum(x * m)])
    centre = (x.sum() + 2.0 * below - below[-1]) / n
    squares = (x**2 + m**2).sum() + 2.0 * (2.0 * below_xm - below_xm[-1])
    z = np.clip(centre, np.concatenate([[-np.inf], x]), np.concatenate([x, [np.inf]]))
    total = n * (z - centre) ** 2 + squares - n * centre**2
    best = int(np.argmin(total))
    return float(z[best]), max(0.0, float(total[best]) / n)
