from __future__ import annotations

import math

import numpy as np
import pytest

from learner.forecast.scalar import NAMES, Contest, ar, candidates, level, line, persistence


def series(*values: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array(values)


def test_persistence_is_the_newest_value() -> None:
    assert persistence(series(1.0, 2.0, 4.0), 7.0) == 4.0


def test_the_line_through_the_last_six() -> None:
    # Ages -2.5 .. 2.5, their squares sum to 17.5; mean 1, slope 2.5 * 6 / 17.5 = 6/7; at 2.5 + 1: 1 + 3 = 4.
    assert line(series(99.0, 0, 0, 0, 0, 0, 6.0), 1.0) == pytest.approx(4.0)
    assert line(series(1.0, 2.0), 2.5) == pytest.approx(4.5)


def test_the_level_of_the_last_three() -> None:
    assert level(series(99.0, 1.0, 2.0, 6.0), 5.0) == 3.0
    assert level(series(1.0, 2.0), 5.0) == 1.5


@pytest.mark.parametrize(("horizon", "wanted"), [(1.0, 2.121891), (2.0, 2.898481), (1.5, 2.510186)])
def test_the_ridge_of_the_autoregression(horizon: float, wanted: float) -> None:
    """One equation: z_2 - z_1 = 0.5 = c + a z_1 + b z_0 with z = (0, 1, 1.5), so f = (1, 1, 0).

    (c, a, b) = 0.5 f / (f.f + 0.01) = 0.248756 f. h = 1: 1.5 + 0.248756 (1 + 1.5) = 2.121891; h = 2:
    2.121891 + 0.248756 (1 + 2.121891) = 2.898481; between them: their mean.
    """
    assert ar(series(0.0, 1.0, 1.5), horizon) == pytest.approx(wanted, abs=1e-6)


def test_the_autoregression_continues_a_sine() -> None:
    t = np.arange(50)
    ahead = ar(100 * np.sin(2 * np.pi * t / 30), 6.0)  # 30 units are a period: t = 55
    assert ahead == pytest.approx(100 * math.sin(2 * math.pi * 55 / 30), abs=0.5)


def test_the_autoregression_does_not_run_away() -> None:
    # Doubling from 0 to 3: one more step would be 6.98, one width above the range is 6.
    assert ar(series(0.0, 1.0, 3.0), 1.0) == 6.0
    assert ar(series(0.0, -1.0, -3.0), 50.0) == -6.0


@pytest.mark.parametrize("values", [[5.0], [5.0, 5.0], [5.0] * 100])
def test_what_stands_still_is_forecast_to(values: list[float]) -> None:
    assert candidates(values, 3.5) == pytest.approx([5.0] * len(NAMES))


def test_the_contest_by_hand() -> None:
    contest = Contest()
    assert (contest.best, contest.rms().tolist()) == (0, [0.0] * 4)
    contest.judge(series(1.0), 2.0)  # with one value all say 1
    assert contest.errors.tolist() == [1.0] * 4
    contest.judge(series(1.0, 2.0), 3.0)  # they say 2, 3, 1.5, 2
    assert contest.errors == pytest.approx([0.85 + 1.0, 0.85, 0.85 + 2.25, 0.85 + 1.0])
    assert NAMES[contest.best] == "line"
    assert contest.rms()[1] == pytest.approx(math.sqrt(0.85 / 1.85))


def test_old_errors_are_forgotten() -> None:
    contest = Contest()
    for _ in range(10):
        contest.judge(series(0.0, 1.0), 2.0)  # the line is right
    assert NAMES[contest.best] == "line"
    for _ in range(10):
        contest.judge(series(0.0, 1.0), 1.0)  # persistence is
    assert NAMES[contest.best] == "persistence"
