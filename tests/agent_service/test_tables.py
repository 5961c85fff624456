"""Policies of finite worlds, against the rows that they draw from."""

from __future__ import annotations

import numpy as np

from agent_service.tables import DRAWS, CategoricalPolicy, UniformChoice


class Fixed(np.random.Generator):
    """Draws the numbers that it is given, in a round."""

    def __init__(self, *numbers: float) -> None:
        super().__init__(np.random.PCG64(0))
        self._numbers = numbers

    def random(self, *_: object, out: np.ndarray) -> np.ndarray:  # type: ignore[override]
        out[:] = np.resize(self._numbers, len(out))
        return out


def state(number: int) -> np.ndarray:
    return np.array([number], np.float32)


def actions(policy: CategoricalPolicy, number: int, rng: np.random.Generator, count: int) -> list[float]:
    return [float(policy.act(state(number), rng)[0]) for _ in range(count)]


def test_draws_by_hand() -> None:
    """State 0 changes its action at 0.25 and 0.75, state 1 at 0.5 and 0.5: action 1 never acts there."""
    table = np.array([[0.25, 0.5, 0.25], [0.5, 0.0, 0.5]], np.float32)
    rng = Fixed(0.0, 0.2499, 0.25, 0.5, 0.7499, 0.75, 0.9999)
    assert actions(CategoricalPolicy(1, table), 0, rng, 7) == [0, 0, 1, 1, 1, 2, 2]
    assert actions(CategoricalPolicy(1, table), 1, rng, 7) == [0, 0, 0, 2, 2, 2, 2]


def test_an_action_of_probability_0_never_acts() -> None:
    """A row may sum to 0.9999 in float32, and a draw may be 0 or just below 1."""
    table = np.array([[0.0, 0.4999, 0.5, 0.0], [0.0, 0.0, 0.9999, 0.0]], np.float32)
    below_1 = float(np.nextafter(1.0, 0.0))
    policy = CategoricalPolicy(1, table)
    assert actions(policy, 0, Fixed(0.0, below_1), 2) == [1, 2]
    assert actions(CategoricalPolicy(1, table), 1, Fixed(0.0, 0.99995, below_1), 3) == [2, 2, 2]


def test_frequencies_are_the_probabilities_and_repeat_with_the_seed() -> None:
    table = np.random.default_rng(0).dirichlet(np.ones(5), 3).astype(np.float32)
    policy, count = CategoricalPolicy(1, table), 40_000
    rng = np.random.default_rng(1)
    for number, row in enumerate(table):
        drawn = actions(policy, number, rng, count)
        # four standard deviations of a frequency are 4 sqrt(p (1 - p) / n) <= 0.01
        np.testing.assert_allclose(np.bincount(np.array(drawn, int), minlength=5) / count, row, atol=0.01)
    again = actions(CategoricalPolicy(1, table), 0, np.random.default_rng(1), 3 * DRAWS)
    assert again == actions(CategoricalPolicy(1, table), 0, np.random.default_rng(1), 3 * DRAWS)
    assert again != actions(CategoricalPolicy(1, table), 0, np.random.default_rng(2), 3 * DRAWS)


def test_answers_are_one_float32() -> None:
    rng = np.random.default_rng(0)
    for policy in (CategoricalPolicy(4, np.ones((2, 1), np.float32)), UniformChoice(1)):
        answer = policy.act(state(1), rng)
        assert answer.dtype == np.float32
        assert answer.tolist() == [0.0]


def test_pi_0_chooses_evenly() -> None:
    policy, rng, count = UniformChoice(4), np.random.default_rng(2), 40_000
    drawn = [int(policy.act(state(0), rng)[0]) for _ in range(count)]
    np.testing.assert_allclose(np.bincount(drawn, minlength=4) / count, 0.25, atol=0.01)
