from __future__ import annotations

import warnings
from array import array

import numpy as np

from benchmarks.harness import child_result
from benchmarks.rtgym_world import pacing_errors, timeouts


def test_errors_are_against_the_grid_through_the_most_punctual_tick() -> None:
    instants = np.array([105, 201, 300, 420])  # on the grid 100, 200, 300, 400: late by 5, 1, 0, 20
    assert pacing_errors(instants, 100, []).tolist() == [5, 1, 0, 20]


def test_a_clock_set_anew_has_a_grid_of_its_own() -> None:
    instants = np.array([100, 203, 450, 550, 651])
    assert pacing_errors(instants, 100, [2]).tolist() == [0, 3, 0, 0, 1]


def test_no_instants_have_no_errors() -> None:
    assert pacing_errors(np.empty(0, np.int64), 100, []).tolist() == []


def test_a_warning_of_a_timeout_names_the_control_before_it() -> None:
    controlled = array("q")
    with timeouts(controlled) as found:
        controlled.extend([1, 2])
        warnings.warn("Time-step timed out. Elapsed since last time-step: 1", stacklevel=1)
        warnings.warn("something else", stacklevel=1)
        controlled.append(3)
        warnings.warn("Time-step timed out. Elapsed since last time-step: 2", stacklevel=1)
    assert found == [1, 2]


def test_rtgym_really_ticks() -> None:
    options = ["--variant", "v1", "--hz", "50", "--seconds", "0.3", "--rt", "off"]
    found = child_result("benchmarks.rtgym_world", options, seconds=0.3)
    assert 1 <= found["ticks"] <= 17  # 15 in time, and what its elastic clock may be ahead
    assert found["pacing_us"]["p50"] is not None
