from __future__ import annotations

import math

import pytest

from env_server.worlds.drift import value
from rtcore.config import DriftConfig


def test_none_is_zero_whatever_the_numbers() -> None:
    drift = DriftConfig(kind="none", offset=3.0, amplitude=2.0, omega=1.0)
    assert [value(drift, t) for t in (0, 1, 7)] == [0.0, 0.0, 0.0]


def test_constant_stays() -> None:
    drift = DriftConfig(kind="constant", offset=1.5, amplitude=2.0, omega=1.0)
    assert [value(drift, t) for t in (0, 1, 7)] == [1.5, 1.5, 1.5]


def test_sine_by_hand() -> None:
    # a quarter turn per unit: offset, offset + a, offset, offset - a, offset
    drift = DriftConfig(kind="sine", offset=1.0, amplitude=0.5, omega=math.pi / 2)
    assert [value(drift, t) for t in range(5)] == pytest.approx([1.0, 1.5, 1.0, 0.5, 1.0])


def test_sine_with_phase_by_hand() -> None:
    # sin(pi / 6) = 1/2, sin(pi / 6 + pi / 3) = 1
    drift = DriftConfig(kind="sine", amplitude=2.0, omega=math.pi / 3, phase=math.pi / 6)
    assert [value(drift, t) for t in (0, 1)] == pytest.approx([1.0, 2.0])


def test_the_authors_values() -> None:
    # 1.0 + 0.2 sin(0.001 * 500) = 1 + 0.2 * 0.479425538604203
    drift = DriftConfig(kind="sine", offset=1.0, amplitude=0.2, omega=0.001)
    assert value(drift, 500) == pytest.approx(1.0958851077208406, rel=1e-12)
