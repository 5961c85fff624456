"""A finite world that elapses: one MDP per unit of time (paper, section 3, time-elapsing MDP)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtcore.config import ConfigError

Floats = NDArray[np.float64]

_STOCHASTIC = 1e-9  # of a row's sum: the rounding of a thousand additions is far below


@dataclass(frozen=True, eq=False)
class TimeElapsingMdp:
    """M_t = (S, A, P_t, R_t, gamma, H) for t = 0..T-1. The paper writes P_t of S x A x S; it is of S x A.

    The arrays are copied and cannot be written to.

    Attributes:
        reward: R_t(s, a), [T, S, A], per step.
        transition: P_t(s'|s, a), [T, S, A, S]; each row sums to 1.
        gamma: discount per step, in [0, 1).
        horizon: H >= 1 steps of an episode; None: it never ends.

    Raises:
        ConfigError: a shape that does not fit, no units, states or actions, a number that is not finite,
            a row that is no distribution, gamma outside [0, 1), or H < 1.
    """

    reward: Floats
    transition: Floats
    gamma: float
    horizon: int | None = None

    def __post_init__(self) -> None:
        reward = _frozen("reward", self.reward, 3)
        transition = _frozen("transition", self.transition, 4)
        expected = (*reward.shape, reward.shape[1])
        if transition.shape != expected:
            raise ConfigError("transition.shape", transition.shape, f"must be [T, S, A, S] = {expected}")
        check_distributions("transition", transition)
        check_discount(self.gamma, self.horizon)
        object.__setattr__(self, "reward", reward)
        object.__setattr__(self, "transition", transition)

    @property
    def units(self) -> int:
        """T."""
        return len(self.reward)

    @property
    def states(self) -> int:
        """|S|."""
        return int(self.reward.shape[1])

    @property
    def actions(self) -> int:
        """|A|."""
        return int(self.reward.shape[2])

    @property
    def r_max(self) -> float:
        """The largest |R_t(s, a)| over t, s, a."""
        return float(np.abs(self.reward).max())

    @property
    def steps(self) -> float:
        """The discounted number of steps in an episode, h = sum_{i<H} gamma^i."""
        return discounted_steps(self.gamma, self.horizon)

    @property
    def tail(self) -> float:
        """gamma^H r_max / (1 - gamma): what an infinite horizon can add to or take from any value."""
        return 0.0 if self.horizon is None else self.gamma**self.horizon * self.r_max / (1.0 - self.gamma)


def discounted_steps(gamma: float, horizon: int | None) -> float:
    """The paper's h = sum_{i<H} gamma^i = (1 - gamma^H) / (1 - gamma); 1 / (1 - gamma) for H = None."""
    check_discount(gamma, horizon)
    return (1.0 - (0.0 if horizon is None else gamma**horizon)) / (1.0 - gamma)


def discounted_index(gamma: float, horizon: int | None) -> float:
    """The sum over i < H of i gamma^i, in C_5: gamma / (1 - gamma) (h - gamma^(H-1) H).

    For H = None it is gamma / (1 - gamma)^2.
    """
    steps = discounted_steps(gamma, horizon)
    last = 0.0 if horizon is None else gamma ** (horizon - 1) * horizon
    return gamma / (1.0 - gamma) * (steps - last)


def check_discount(gamma: float, horizon: int | None) -> None:
    """Refuse what is no discount or no horizon.

    Raises:
        ConfigError: gamma outside [0, 1), or H < 1.
    """
    if not 0.0 <= gamma < 1.0:
        raise ConfigError("gamma", gamma, "must be in [0, 1)")
    if horizon is not None and not (horizon >= 1 and float(horizon).is_integer()):
        raise ConfigError("horizon", horizon, "must be a whole number >= 1, or None for no end")


def check_policies(name: str, policy: Floats, shape: tuple[int, ...]) -> Floats:
    """`policy` as float64, if it is pi(a|s) of that shape [..., S, A].

    Raises:
        ConfigError: another shape, or a row that is no distribution.
    """
    policy = np.asarray(policy, np.float64)
    if policy.shape != shape:
        raise ConfigError(f"{name}.shape", policy.shape, f"must be {shape}")
    check_distributions(name, policy)
    return policy


def check_distributions(name: str, rows: Floats) -> None:
    """Refuse rows [..., n] that are no distributions, and name the first of them.

    Raises:
        ConfigError: a row with a negative number or NaN, or whose sum is not 1.
    """
    bad = ~((rows >= 0).all(-1) & (np.abs(rows.sum(-1) - 1.0) <= _STOCHASTIC))
    if bad.any():
        where = _first(bad)
        raise ConfigError(f"{name}{list(where)}", rows[where].tolist(), "must be >= 0 and sum to 1")


def _frozen(name: str, value: Any, axes: int) -> Floats:
    try:
        array: Floats = np.array(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(name, value, f"must be an array of numbers with {axes} axes") from error
    if array.ndim != axes or not array.size:
        raise ConfigError(f"{name}.shape", array.shape, f"must have {axes} axes, none of them empty")
    if not np.isfinite(array).all():
        where = _first(~np.isfinite(array))
        raise ConfigError(f"{name}{list(where)}", float(array[where]), "must be finite")
    array.flags.writeable = False
    return array


def _first(flags: NDArray[np.bool_]) -> tuple[int, ...]:
    return tuple(int(index) for index in np.argwhere(flags)[0])
