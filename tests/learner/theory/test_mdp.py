"""Time-elapsing MDPs and their budgets: by hand, against the definitions, and what is refused."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from learner.theory import budgets
from learner.theory.mdp import TimeElapsingMdp, discounted_index, discounted_steps
from rtcore.config import ConfigError
from tests.learner.theory.worlds import bandit

CHANGES = st.lists(st.floats(0, 10), min_size=1, max_size=12).map(np.array)


def _two_units() -> tuple[np.ndarray, np.ndarray]:
    reward = np.array([[[1.0, -3.0]], [[1.5, -2.0]]])
    return reward, np.ones((2, 1, 2, 1))


def test_the_shape_of_a_world_is_read_from_its_arrays() -> None:
    world = TimeElapsingMdp(np.zeros((5, 3, 2)) - 4, np.full((5, 3, 2, 3), 1 / 3), 0.5, 2)
    assert (world.units, world.states, world.actions, world.r_max) == (5, 3, 2, 4.0)
    assert world.steps == 1.5  # 1 + 0.5
    assert world.tail == pytest.approx(0.25 * 4 / 0.5)


def test_the_arrays_of_a_world_are_its_own() -> None:
    reward, transition = _two_units()
    world = TimeElapsingMdp(reward, transition, 0.0)
    reward[:] = 7
    assert world.reward[0, 0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        world.reward[0, 0, 0] = 2.0


@pytest.mark.parametrize(
    ("reward", "transition", "gamma", "horizon", "said"),
    [
        (np.zeros((2, 1)), np.ones((2, 1, 2, 1)), 0.5, None, "reward.shape = (2, 1): must have 3 axes"),
        (np.zeros((0, 1, 2)), np.ones((0, 1, 2, 1)), 0.5, None, "reward.shape = (0, 1, 2): must have 3"),
        (np.zeros((2, 1, 2)), np.ones((3, 1, 2, 1)), 0.5, None, "must be [T, S, A, S] = (2, 1, 2, 1)"),
        (
            np.full((1, 1, 1), np.nan),
            np.ones((1, 1, 1, 1)),
            0.5,
            None,
            "reward[0, 0, 0] = nan: must be finite",
        ),
        (np.zeros((1, 1, 2)), np.array([[[[1.0], [0.9]]]]), 0.5, None, "transition[0, 0, 1] = [0.9]: must"),
        (np.zeros((1, 2, 1)), np.array([[[[2.0, -1.0]], [[1, 0]]]]), 0.5, None, "transition[0, 0, 0] = [2.0"),
        (np.zeros((1, 1, 2)), np.array([[[[1.0], [np.nan]]]]), 0.5, None, "transition[0, 0, 1, 0] = nan"),
        (
            np.zeros((1, 2, 1)),
            np.full((1, 2, 1, 3), 1 / 3),
            0.5,
            None,
            "transition.shape = (1, 2, 1, 3): must",
        ),
        ([[[0.0], [0.0, 1.0]]], np.ones((1, 2, 1, 2)), 0.5, None, "reward = [[[0.0], [0.0, 1.0]]]: must be"),
        (np.zeros((1, 1, 1)), np.ones((1, 1, 1, 1)), -0.1, None, "gamma = -0.1: must be in [0, 1)"),
        (np.zeros((1, 1, 1)), np.ones((1, 1, 1, 1)), 0.5, 2.5, "horizon = 2.5: must be a whole number"),
        (np.zeros((1, 1, 1)), np.ones((1, 1, 1, 1)), 0.5, np.inf, "horizon = inf: must be a whole number"),
        (np.zeros((1, 1, 1)), np.ones((1, 1, 1, 1)), 1.0, None, "gamma = 1.0: must be in [0, 1)"),
        (np.zeros((1, 1, 1)), np.ones((1, 1, 1, 1)), float("nan"), None, "gamma = nan: must be in [0, 1)"),
        (np.zeros((1, 1, 1)), np.ones((1, 1, 1, 1)), 0.5, 0, "horizon = 0: must be a whole number >= 1"),
    ],
)
def test_what_is_no_world_is_refused_in_one_line(
    reward: np.ndarray, transition: np.ndarray, gamma: float, horizon: int | None, said: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        TimeElapsingMdp(reward, transition, gamma, horizon)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("gamma", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("horizon", [1, 2, 7])
def test_h_and_k_are_the_sums_that_they_stand_for(gamma: float, horizon: int) -> None:
    assert discounted_steps(gamma, horizon) == pytest.approx(sum(gamma**i for i in range(horizon)))
    assert discounted_index(gamma, horizon) == pytest.approx(
        sum(i * gamma**i for i in range(horizon)), abs=1e-12
    )


def test_h_and_k_of_endless_episodes_are_limits() -> None:
    assert discounted_steps(0.9, None) == pytest.approx(10)
    assert discounted_index(0.9, None) == pytest.approx(90)  # 0.9 / 0.1^2
    assert discounted_index(0.9, None) == pytest.approx(discounted_index(0.9, 1000))


# -- budgets


def test_changes_are_the_largest_over_states_and_actions() -> None:
    reward, transition = np.zeros((3, 2, 2)), np.full((3, 2, 2, 2), 0.5)
    reward[1, 0, 1], reward[1, 1, 0] = 2.0, -3.0  # |.| 3 there and back again
    transition[2, 1, 1] = [0.9, 0.1]  # |0.4| + |-0.4|
    world = TimeElapsingMdp(reward, transition, 0.5)
    assert budgets.reward_changes(world).tolist() == [3.0, 3.0]
    assert budgets.transition_changes(world) == pytest.approx([0.0, 0.8])


def test_budgets_by_hand() -> None:
    b = np.array([1.0, 2.0, 4.0])
    assert budgets.local(b, 0, 3) == 7
    assert budgets.local(b, 2, 2) == 0
    # B(0,0) + B(0,1) + B(0,2) = 0 + 1 + 3; from the right B(0,2) + B(1,2) + B(2,2) = 3 + 2 + 0
    assert budgets.cumulative(b, 0, 3) == 4
    assert budgets.cumulative_right(b, 0, 3) == 5
    assert budgets.cumulative(b, 0, 4) == 11  # one more unit than there are changes: + B(0,3) = 7


@given(b=CHANGES, data=st.data())
def test_budgets_are_their_definitions(b: np.ndarray, data: st.DataObject) -> None:
    begin = data.draw(st.integers(0, len(b) + 1))
    end = data.draw(st.integers(begin, len(b) + 1))

    def total(t1: int, t2: int) -> float:
        return float(sum(b[t] for t in range(t1, t2)))

    left = sum(total(begin, t) for t in range(begin, end))
    right = sum(total(t, end - 1) for t in range(begin, end))
    assert budgets.cumulative(b, begin, end) == pytest.approx(left)
    assert budgets.cumulative_right(b, begin, end) == pytest.approx(right)
    if end <= len(b):
        assert budgets.local(b, begin, end) == pytest.approx(total(begin, end))


@pytest.mark.parametrize("interval", [(-1, 2), (2, 1), (0, 5)])
def test_an_interval_outside_of_the_world_is_refused(interval: tuple[int, int]) -> None:
    for sum_up in (budgets.local, budgets.cumulative, budgets.cumulative_right):
        with pytest.raises(ConfigError, match="interval"):
            sum_up(np.ones(3), *interval)


def test_a_phase_without_units_has_no_budget() -> None:
    for sum_up in (budgets.local, budgets.cumulative, budgets.cumulative_right):
        assert sum_up(np.ones(3), 2, 2) == 0.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (np.ones((3, 1)), r"changes.shape = \(3, 1\): must be \[T - 1\]"),
        (np.array([1.0, -2.0]), r"changes = \[1.0, -2.0\]: must be >= 0"),
        (np.array([np.nan]), "changes = .*nan.*: must be >= 0"),
    ],
)
def test_what_are_no_changes_is_refused(changes: np.ndarray, said: str) -> None:
    for sum_up in (budgets.local, budgets.cumulative, budgets.cumulative_right):
        with pytest.raises(ConfigError, match=said):
            sum_up(changes, 0, 1)


def _both_phases(b: np.ndarray) -> list[float]:
    """Bbar(0, G) + Bbar(G, 6) for G = 0 .. 6, with C_4 = C_5 = 1."""
    return [budgets.cumulative(b, 0, g) + budgets.cumulative(b, g, 6) for g in range(7)]


def test_the_paper_s_example_of_a_positive_hold() -> None:
    # two jumps of one half: 1 at (G, N) = (4, 2) and (2, 4), 3 at (6, 0)
    world = bandit([[r, 0.0] for r in (0, 0, 0.5, 0.5, 1, 1)])
    b = np.append(budgets.reward_changes(world), 0.0)
    assert _both_phases(b) == pytest.approx([3, 3, 1, 1.5, 1, 2, 3])


def test_no_other_changes_give_the_paper_s_example() -> None:
    # f(2) = b0 + 3 b2 + 2 b3 + b4 = 1, f(4) = 3 b0 + 2 b1 + b2 + b4 = 1 and
    # f(6) = 5 b0 + 4 b1 + 3 b2 + 2 b3 + b4 = 3. f(6) - f(2) gives b0 + b1 = 1/2; then f(4) gives
    # b0 + b2 + b4 = 0, so b1 = 1/2, and f(2) gives b3 = 1/2.
    grid = (np.array(b) / 4 for b in itertools.product(range(5), repeat=5))
    fits = [b for b in grid if np.allclose(np.array(_both_phases(np.append(b, 0)))[[2, 4, 6]], [1, 1, 3])]
    np.testing.assert_array_equal(fits, [[0, 0.5, 0, 0.5, 0]])


def test_one_jump_of_one_cannot_give_it() -> None:
    assert all(min(_both_phases(np.eye(6)[k])) == 0 for k in range(5))


@given(b=CHANGES.filter(lambda b: len(b) >= 2))
def test_some_hold_is_never_worse_than_none_by_the_budgets_alone(b: np.ndarray) -> None:
    # the proposition on a positive N: f(G) <= f(0) = f(W) inside, and less if anything changes before W - 1
    width = len(b)
    f = [budgets.cumulative(b, 0, g) + budgets.cumulative(b, g, width) for g in range(width + 1)]
    assert f[0] == pytest.approx(f[-1])
    assert max(f[1:-1]) <= f[0] * (1 + 1e-9)
    if budgets.local(b, 0, width - 1) > 1e-6:
        assert min(f[1:-1]) < f[0]
