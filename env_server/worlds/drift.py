"""How the target of a drifting world moves with the unit t. Pure.

One function per kind, in one table: a new kind is a function, a row and its fields in `DriftConfig`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from rtcore.config import DriftConfig, DriftKind


def value(config: DriftConfig, t: int) -> float:
    """The target v_d(t) in unit t >= 0, in the world's units (m/s for the speed worlds)."""
    return _KINDS[config.kind](config, t)


def _none(_config: DriftConfig, _t: int) -> float:
    return 0.0


def _constant(config: DriftConfig, _t: int) -> float:
    return config.offset


def _sine(config: DriftConfig, t: int) -> float:
    """v_d(t) = offset + a sin(omega t + phase); the paper has offset and phase 0 (appendix, environments)."""
    return config.offset + config.amplitude * math.sin(config.omega * t + config.phase)


_KINDS: dict[DriftKind, Callable[[DriftConfig, int], float]] = {
    "none": _none,
    "constant": _constant,
    "sine": _sine,
}
