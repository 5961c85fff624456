from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.recency import unit_ages
from learner.replay import Replay, make_batch


def replay_of(units: list[int], capacity: int = 100) -> Replay:
    """One transition per entry, whose reward is its index."""
    replay = Replay(capacity, 1, 1)
    zero = np.zeros(1, np.float32)
    for index, unit in enumerate(units):
        replay.add(zero, zero, float(index), zero, False, unit)
    return replay


def drawn(replay: Replay, size: int, recency: float, since: int | None = None) -> list[int]:
    batch = make_batch(size, 1, 1)
    replay.sample(np.random.default_rng(0), batch, since, recency)
    return [int(reward) for reward in batch.reward]


def test_ages_invert_the_cut_off_exponential() -> None:
    # mean 1 / ln 2 halves the share with every unit; of 3 units, ages 0, 1, 2 get 4/7, 2/7 and 1/7
    edges = [0.0, 4 / 7 - 1e-9, 4 / 7 + 1e-9, 6 / 7 - 1e-9, 6 / 7 + 1e-9, 1 - 2**-53]
    assert unit_ages(np.array(edges), 1 / math.log(2), 3).tolist() == [0, 0, 1, 1, 2, 2]


@given(mean=st.floats(1e-3, 1e6), span=st.integers(1, 10**6))
def test_ages_stay_within_what_is_held(mean: float, span: int) -> None:
    ages = unit_ages(np.array([0.0, 0.5, 1 - 2**-53]), mean, span)
    assert 0 == ages[0] <= ages[1] <= ages[2] < span


def test_newer_units_come_more_often() -> None:
    # Units 0..3 of one transition each. Unit 3 is under way and counts with unit 2, so with shares that
    # halve with every unit: {2, 3} 4/7, 1 2/7, 0 1/7. Draws are within 4 standard deviations.
    counts = np.bincount(drawn(replay_of([0, 1, 2, 3]), 7000, 1 / math.log(2)), minlength=4)
    assert counts.tolist() == pytest.approx([1000, 2000, 2000, 2000], abs=160)


def test_within_a_unit_draws_are_uniform() -> None:
    counts = np.bincount(drawn(replay_of([0, 0, 0, 0, 0, 1]), 6000, 1.0), minlength=6)
    assert counts.tolist() == pytest.approx([1000] * 6, abs=120)


def test_a_unit_without_transitions_gives_its_share_to_the_next_older_one() -> None:
    # ages 0..4 for units 4..0, unit 5 under way; 1 to 3 have none. 16 8 4 2 1 of 31: unit 4 and 5 take 16,
    # unit 0 the other 15
    counts = np.bincount(drawn(replay_of([0, 4, 5]), 6200, 1 / math.log(2)), minlength=3)
    assert counts.tolist() == pytest.approx([3000, 1600, 1600], abs=160)


def test_only_from_the_window_of_units() -> None:
    assert set(drawn(replay_of([0, 1, 2, 3, 4]), 500, 100.0, since=2)) == {2, 3, 4}


def test_a_long_memory_is_uniform_over_units() -> None:
    counts = np.bincount(drawn(replay_of([0, 1, 1, 2, 3]), 6000, 1e6), minlength=5)
    assert counts.tolist() == pytest.approx([2000, 1000, 1000, 1000, 1000], abs=150)


@settings(deadline=None)
@given(
    capacity=st.integers(1, 12),
    steps=st.lists(st.integers(0, 3), min_size=1, max_size=40),
    since=st.one_of(st.none(), st.integers(0, 30)),
    mean=st.sampled_from([0.3, 2.0, 50.0]),
)
def test_it_agrees_with_a_list(capacity: int, steps: list[int], since: int | None, mean: float) -> None:
    units = [int(unit) for unit in np.cumsum(steps)]
    replay = replay_of(units, capacity)
    held = [(index, unit) for index, unit in enumerate(units)][-capacity:]
    wanted = [(index, unit) for index, unit in held if since is None or unit >= since]
    if not wanted:
        with pytest.raises(ValueError, match="no transition to draw from"):
            drawn(replay, 10, mean, since)
        return
    share = shares(wanted, mean)
    counts = np.bincount(drawn(replay, 2000, mean, since), minlength=len(units))
    assert counts.sum() == 2000
    for index, unit in enumerate(units):
        expected = 2000 * share.get(index, 0.0)
        assert counts[index] == pytest.approx(expected, abs=6 * math.sqrt(expected) + (expected > 0) * 4), (
            unit
        )
    mean_unit = sum(part * units[index] for index, part in share.items())
    assert replay.mean_unit(since, mean) == pytest.approx(mean_unit)


def shares(held: list[tuple[int, int]], mean: float) -> dict[int, float]:
    """How likely each transition is, counted out."""
    oldest, newest = held[0][1], held[-1][1]
    base = max(newest - 1, oldest)
    raw = {unit: math.exp((unit - base) / mean) for unit in range(oldest, base + 1)}
    share = {index: 0.0 for index, _ in held}
    for unit, part in raw.items():
        own = [index for index, other in held if other == unit or other > base == unit]
        at = unit
        while not own:
            at -= 1
            own = [index for index, other in held if other == at]
        for index in own:
            share[index] += part / sum(raw.values()) / len(own)
    return share


def test_the_mean_unit_of_uniform_draws() -> None:
    replay = replay_of([0, 1, 1, 5], capacity=3)
    assert replay.mean_unit() == pytest.approx(7 / 3)
    assert replay.mean_unit(since_unit=2) == 5.0
    with pytest.raises(ValueError, match="no transition"):
        Replay(3, 1, 1).mean_unit()
