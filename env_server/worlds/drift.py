"""How a quantity moves with the unit t: the target of a drifting world, or a factor on its physics.

One function per kind, in one table: a new kind is a function, a row and its fields in `DriftConfig`.
A value depends on the configuration, the seed and t alone, whoever asks first for what.

What NS-Gym (Keplinger et al., 2025) calls a tunable parameter is the quantity, and what it splits into a
scheduler (when it changes) and an update function (how) is one kind here: `switch` with `every` is a
periodic scheduler with an oscillating update, `burst` a burst scheduler, `random_walk` a continuous
scheduler with a random-walk update.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections.abc import Callable, Iterator

import numpy as np

from env_server.worlds.recorded import read_series
from rtcore.config import ConfigError, DriftConfig, DriftKind

DRIFT_STREAM = 4  # keeps its random numbers apart from the world's, the agent's and the learner's
# One per quantity: two that drift with the same seed do not move together.
TARGET, MASS, FRICTION, GRAVITY = 1, 2, 3, 4

_BLOCK = 256  # values drawn at a time: an OU block takes 0.1 ms, within a tick's slack at 1 kHz
_ZERO = 1e-9  # sin of a multiple of pi comes out as 2e-16 times its argument, of either sign

Formula = Callable[[int], float]


class Drift:
    """A quantity over the units t = 0, 1, ...

    Attributes:
        lowest: no value is below it; -inf where that is not known.
    """

    def __init__(self, config: DriftConfig, formula: Formula, lowest: float) -> None:
        """See `make_drift`."""
        self._formula = formula
        self._low = -math.inf if config.low is None else config.low
        self._high = math.inf if config.high is None else config.high
        self.lowest = min(max(lowest, self._low), self._high)

    def value(self, t: int) -> float:
        """The value in unit t >= 0, within `low` and `high`. A walk goes on beyond them, unseen."""
        return min(max(self._formula(t), self._low), self._high)


def make_drift(
    config: DriftConfig, seed: int, *, stream: int = TARGET, field: str = "env.drift", neutral: float = 0.0
) -> Drift:
    """The drift that `config` describes.

    Args:
        config: checked by `rtcore.config_check`.
        seed: the run's, for what is random, unless `config.seed` is given.
        stream: which quantity it moves.
        field: where `config` stands, for messages.
        neutral: the value of the kind "none".

    Raises:
        ConfigError: the file of a recorded drift cannot be used.
    """
    if config.kind == "none":
        return Drift(DriftConfig(kind="none"), lambda _t: neutral, neutral)
    if config.kind == "recorded":
        return _recorded(config, field)
    source = _Source(config.seed if config.seed is not None else seed, stream)
    return Drift(config, _KINDS[config.kind](config, source), _lowest(config))


class _Source:
    """The random numbers of one drift."""

    def __init__(self, seed: int, stream: int) -> None:
        self._key = [seed, DRIFT_STREAM, stream]

    def instant(self, config: DriftConfig) -> float:
        """`at` in units; where it is random, uniform in [0, span)."""
        if config.at != "random":
            return float(config.at)
        return config.span * float(np.random.default_rng([*self._key, 1]).random())

    def normals(self) -> Iterator[float]:
        """n_0, n_1, ... ~ N(0, 1), independent."""
        random = np.random.default_rng([*self._key, 2])
        while True:
            yield from random.standard_normal(_BLOCK).tolist()


class _Series:
    """x_0, x_1, ... of a recursion, kept as far as it was ever asked for, 8 bytes each."""

    def __init__(self, values: Iterator[float]) -> None:
        self._values = values
        self._known = array("d")

    def __call__(self, t: int) -> float:
        while len(self._known) <= t:
            self._known.extend(next(self._values) for _ in range(_BLOCK))
        return self._known[t]


def _constant(config: DriftConfig, _source: _Source) -> Formula:
    return lambda _t: config.offset


def _sine(config: DriftConfig, _source: _Source) -> Formula:
    """x_t = offset + a sin(omega t + phase); the paper has offset and phase 0 (appendix, environments)."""
    return lambda t: config.offset + config.amplitude * math.sin(config.omega * t + config.phase)


def _square(config: DriftConfig, _source: _Source) -> Formula:
    """x_t = offset + a sgn(sin(omega t + phase)), with sgn(0) = 1."""

    def formula(t: int) -> float:
        up = math.sin(config.omega * t + config.phase) >= -_ZERO
        return config.offset + (config.amplitude if up else -config.amplitude)

    return formula


def _ramp(config: DriftConfig, source: _Source) -> Formula:
    """From offset to offset + a, on a line that begins at `at` and takes `span` units."""
    at = source.instant(config)
    return lambda t: config.offset + config.amplitude * min(max((t - at) / config.span, 0.0), 1.0)


def _switch(config: DriftConfig, source: _Source) -> Formula:
    """Offset before `at`, offset + a from then on; with `every`, back and forth after each so many units."""
    at = source.instant(config)

    def formula(t: int) -> float:
        on = t >= at and (config.every == 0 or (t - at) // config.every % 2 == 0)
        return config.offset + (config.amplitude if on else 0.0)

    return formula


def _burst(config: DriftConfig, source: _Source) -> Formula:
    """Offset + a for `span` units from `at` on, and again each `every` units if given; else offset."""
    at = source.instant(config)

    def formula(t: int) -> float:
        since = (t - at) % config.every if config.every else t - at
        return config.offset + (config.amplitude if t >= at and since < config.span else 0.0)

    return formula


def _random_walk(config: DriftConfig, source: _Source) -> Formula:
    """x_0 = offset, x_{t+1} = x_t + sd n_{t+1}."""

    def walk() -> Iterator[float]:
        x = config.offset
        for n in source.normals():
            yield x
            x += config.sd * n

    return _Series(walk())


def _ou(config: DriftConfig, source: _Source) -> Formula:
    """Ornstein-Uhlenbeck in discrete time: x_0 = offset, x_{t+1} = x_t + rate (offset - x_t) + sd n_{t+1}."""

    def pulled() -> Iterator[float]:
        x = config.offset
        for n in source.normals():
            yield x
            x += config.rate * (config.offset - x) + config.sd * n

    return _Series(pulled())


def _noise(config: DriftConfig, source: _Source) -> Formula:
    """x_t = offset + sd n_t, each unit on its own."""
    return _Series(config.offset + config.sd * n for n in source.normals())


_KINDS: dict[DriftKind, Callable[[DriftConfig, _Source], Formula]] = {
    "constant": _constant,
    "sine": _sine,
    "square": _square,
    "ramp": _ramp,
    "switch": _switch,
    "burst": _burst,
    "random_walk": _random_walk,
    "ou": _ou,
    "noise": _noise,
}


def _recorded(config: DriftConfig, field: str) -> Drift:
    """The value of the newest row at or before t; before the first row, the first."""
    try:
        units, values = read_series(config.path)
    except ValueError as error:
        raise ConfigError(f"{field}.path", config.path, str(error)) from error
    return Drift(config, lambda t: values[max(bisect_right(units, t) - 1, 0)], min(values))


def _lowest(config: DriftConfig) -> float:
    """A lower bound of a kind's formula."""
    match config.kind:
        case "constant":
            return config.offset
        case "sine" | "square":
            return config.offset - abs(config.amplitude)
        case "ramp" | "switch" | "burst":
            return config.offset + min(config.amplitude, 0.0)
        case _:
            return config.offset if config.sd == 0 else -math.inf
