from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.replay import Batch, Replay, make_batch

RNG = np.random.default_rng


def add(replay: Replay, number: int, unit: int) -> None:
    """A transition whose every field says its number."""
    observation = np.array([number, -number], np.float32)
    action = np.array([number / 1000], np.float32)
    replay.add(observation, action, float(number), observation + 1, number % 2 == 1, unit)


def drawn(replay: Replay, since_unit: int | None = None, size: int = 400) -> Batch:
    batch = make_batch(size, 2, 1)
    replay.sample(RNG(0), batch, since_unit)
    return batch


def test_a_sample_keeps_the_fields_of_a_transition_together() -> None:
    replay = Replay(10, 2, 1)
    for number in range(5):
        add(replay, number, 0)
    batch = drawn(replay)
    assert set(batch.reward) == {0, 1, 2, 3, 4}
    np.testing.assert_array_equal(batch.observation, np.stack([batch.reward, -batch.reward], axis=1))
    np.testing.assert_array_equal(batch.next_observation, batch.observation + 1)
    np.testing.assert_allclose(batch.action[:, 0], batch.reward / 1000)
    np.testing.assert_array_equal(batch.terminated, batch.reward % 2 == 1)


def test_a_full_ring_forgets_the_oldest() -> None:
    replay = Replay(4, 2, 1)
    for number in range(10):
        add(replay, number, number)
    assert len(replay) == 4
    assert replay.newest_unit == 9
    assert set(drawn(replay).reward) == {6, 7, 8, 9}


def test_draws_are_uniform() -> None:
    replay = Replay(8, 2, 1)
    for number in range(12):  # the ring wraps in the middle of what is drawn from
        add(replay, number, number // 2)
    counts = np.bincount(drawn(replay, since_unit=3, size=6000).reward.astype(int), minlength=12)
    assert counts[:6].sum() == 0
    assert np.all(np.abs(counts[6:] - 1000) < 150)  # five standard deviations of Binomial(6000, 1/6)


@settings(max_examples=200, deadline=None)
@given(
    capacity=st.integers(1, 12),
    steps=st.lists(st.integers(0, 2), min_size=1, max_size=40),
    since=st.integers(-1, 12),
)
def test_the_recency_window_agrees_with_a_list(capacity: int, steps: list[int], since: int) -> None:
    replay, units = Replay(capacity, 2, 1), np.cumsum(steps).tolist()
    for number, unit in enumerate(units):
        add(replay, number, unit)
    kept = list(enumerate(units))[-capacity:]
    wanted = {number for number, unit in kept if unit >= since}
    assert replay.count_since(since) == len(wanted)
    if wanted:
        assert set(drawn(replay, since).reward) <= wanted
    else:
        with pytest.raises(ValueError, match="no transition to draw from"):
            drawn(replay, since)


def test_an_empty_replay_cannot_be_sampled() -> None:
    replay = Replay(4, 2, 1)
    assert replay.newest_unit == -1
    with pytest.raises(ValueError, match="0 held"):
        drawn(replay)


def test_a_unit_that_goes_back_is_raised_and_counted() -> None:
    replay = Replay(8, 2, 1)
    for number, unit in enumerate([3, 5, 2, 6]):
        add(replay, number, unit)
    assert replay.raised_units == 1
    assert set(drawn(replay, since_unit=5).reward) == {1, 2, 3}


def test_equal_seeds_draw_equal_batches() -> None:
    replay = Replay(100, 2, 1)
    for number in range(50):
        add(replay, number, 0)
    np.testing.assert_array_equal(drawn(replay).reward, drawn(replay).reward)


def test_the_content_hash_is_of_what_is_held() -> None:
    wrapped, straight = Replay(3, 2, 1), Replay(5, 2, 1)
    for number in range(5):
        add(wrapped, number, number)
    for number in range(2, 5):
        add(straight, number, number)
    assert wrapped.content_hash() == straight.content_hash()
    add(straight, 5, 5)
    assert wrapped.content_hash() != straight.content_hash()


def test_transitions_are_read_by_number_across_the_rings_end() -> None:
    replay = Replay(4, 1, 1)
    for number in range(6):  # 0 and 1 are overwritten; the ring wraps between 3 and 4
        value = np.array([number], np.float32)
        replay.add(value, value, float(number), value, False, number)
    assert replay.added == 6
    assert replay.read(3, 2).reward.tolist() == [3.0, 4.0]
    assert replay.read(5, 9).reward.tolist() == [5.0]
    assert replay.read(0, 3).reward.tolist() == [2.0, 3.0, 4.0]  # begins with the oldest held
    assert replay.read(6, 3).reward.tolist() == []
    assert replay.read(2, 9).unit.tolist() == [2, 3, 4, 5]
