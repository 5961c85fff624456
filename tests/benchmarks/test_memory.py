"""Growth, from hand-made samples."""

from __future__ import annotations

import pytest

from benchmarks.memory import Sample, growth, process


def samples(own: list[int]) -> list[Sample]:
    return [Sample(10.0 * i, value, 2 * value) for i, value in enumerate(own)]


def test_growth_is_between_the_first_and_the_last_minute_after_the_warm_up() -> None:
    series = samples([1] * 6 + [100] * 7 + [500] * 5 + [102] * 7)
    found = growth(series)
    assert found["own"] == {"first_mb": 100e-6, "last_mb": 102e-6, "growth": pytest.approx(0.02)}
    assert found["resident"]["last_mb"] == 204e-6


def test_a_run_that_ends_in_its_warm_up_says_nothing() -> None:
    with pytest.raises(ValueError, match="samples over 50 s: must be over more than 60 s"):
        growth(samples([1] * 6))


def test_a_process_is_known_by_its_module() -> None:
    assert process(["python", "-m", "learner", "--run", "x"]) == "learner"
    assert process(["python", "-m", "env_server", "--run", "learner", "--index", "3"]) == "env_server.3"
    assert process(["python", "-m", "pytest"]) is None
