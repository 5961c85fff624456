"""The exact tables of finite worlds, held against what the worlds do when they are stepped."""

from __future__ import annotations

import numpy as np
import pytest

from env_server.worlds.bandit import Bandit
from env_server.worlds.cliffworld import GOALS, START, STATES, Cliffworld
from env_server.worlds.mdp import Chain
from rtcore.config import CliffConfig, MdpConfig

READINGS = [
    CliffConfig(pays=pays, inactive_goal=inactive)
    for pays in ("leave", "arrive")
    for inactive in ("ordinary", "terminal")
]


def test_a_bandits_tables_are_its_chances() -> None:
    tables = Bandit(lambda t: 0.25 * t, seed=0).tables(1)
    np.testing.assert_array_equal(tables.reward, [[0.25, 0.75]])
    np.testing.assert_array_equal(tables.transition, np.ones((1, 2, 1)))
    np.testing.assert_array_equal(Bandit(lambda _t: 0.0, seed=0).starts(), [1.0])


@pytest.mark.parametrize("cliff", READINGS)
@pytest.mark.parametrize("goal", [0, 1])
def test_the_cliffworlds_tables_are_its_steps(cliff: CliffConfig, goal: int) -> None:
    """Nothing in it is random, so one step of each action in each cell says everything."""
    world = Cliffworld(cliff, lambda _t: float(goal), seed=0)
    tables = world.tables(0)
    assert (tables.reward.shape, tables.transition.shape) == ((37, 4), (37, 4, 37))
    for state in range(STATES):
        for action in range(4):
            world.state = state
            outcome = world.step(np.array([action], np.float32), 0)
            following = STATES if outcome.terminated else int(outcome.observation[0])
            assert tables.reward[state, action] == outcome.reward
            assert tables.transition[state, action].tolist() == np.eye(37)[following].tolist()
    assert not tables.reward[STATES].any()
    assert (tables.transition[STATES, :, STATES] == 1).all()


def test_the_cliffworlds_tables_follow_its_goal() -> None:
    world = Cliffworld(CliffConfig(), lambda t: float(t >= 3), seed=0)
    for t, goal in ((2, 0), (3, 1)):
        reward = world.tables(t).reward
        assert [reward[GOALS[goal], 0], reward[GOALS[1 - goal], 0]] == [100.0, -1.0]


def test_where_episodes_begin() -> None:
    starts = Cliffworld(CliffConfig(), lambda _t: 0.0, seed=0).starts()
    assert (starts.shape, starts[START], starts.sum()) == ((37,), 1.0, 1.0)
    chain = Chain(lambda _t: 0.0, MdpConfig(states=4), seed=0)
    np.testing.assert_array_equal(chain.starts(), [0.25] * 4)
    counts = np.bincount([int(chain.reset(None, 0)[0]) for _ in range(2000)], minlength=4) / 2000
    np.testing.assert_allclose(counts, chain.starts(), atol=0.05)  # five standard deviations
