"""The cliffworld's transitions by hand, in every reading; and what finite worlds share.

Cell (x, y) is state 12 y + x: (0, 1) = 12, (5, 0) = 5, (5, 1) = 17, (5, 2) = 29, (11, 1) = 23, and the
goals (11, 0) = 11 and (11, 2) = 35.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from env_server.worlds.cliffworld import START, Cliffworld, active_goal, tables
from env_server.worlds.world import Outcome, World
from rtcore.board import board_path, load_board
from rtcore.config import CliffConfig

UP, DOWN, LEFT, RIGHT = range(4)
LEAVE = CliffConfig()
LEAVE_ORDINARY = CliffConfig(inactive_goal="ordinary")
ARRIVE = CliffConfig(pays="arrive")
ARRIVE_ORDINARY = CliffConfig(pays="arrive", inactive_goal="ordinary")
READINGS = (LEAVE, LEAVE_ORDINARY, ARRIVE, ARRIVE_ORDINARY)
RESTARTS = [*range(1, 11), *range(25, 35)]


def number(value: float) -> np.ndarray:
    return np.array([value], np.float32)


def live(world: World, actions: list[int], t: int = 0) -> list[Outcome]:
    return [world.step(number(action), t) for action in actions]


def states(outcomes: list[Outcome]) -> list[int]:
    return [int(outcome.observation[0]) for outcome in outcomes]


def test_the_defaults_are_the_documented_reading() -> None:
    assert (LEAVE.pays, LEAVE.inactive_goal) == ("leave", "terminal")
    assert (LEAVE.step_reward, LEAVE.goal_reward, LEAVE.restart_reward) == (-1.0, 100.0, -100.0)


@pytest.mark.parametrize("cliff", READINGS)
def test_moves(cliff: CliffConfig) -> None:
    next_state = tables(cliff, 0).next_state
    np.testing.assert_array_equal(next_state[17], [5, 29, 16, 18])
    np.testing.assert_array_equal(next_state[0], [0, 12, 0, 1])  # against the edge it stays
    np.testing.assert_array_equal(next_state[START], [12, 24, 24, 25])
    np.testing.assert_array_equal(next_state[23], [11, 35, 22, 23])
    assert (next_state[RESTARTS] == START).all()


@pytest.mark.parametrize("goal", [0, 1])
def test_leaving_pays(goal: int) -> None:
    now, (active, other) = tables(LEAVE, goal), ((11, 35), (35, 11))[goal]
    for state, reward, terminated in (
        (17, -1, False), (23, -1, False), (START, -1, False), (5, -100, False), (29, -100, False),
        (active, 100, True), (other, -1, True),
    ):  # fmt: skip
        assert (now.reward[state] == reward).all()
        assert (now.terminated[state] == terminated).all()
    assert (now.next_state[active] == active).all() and (now.next_state[other] == other).all()


@pytest.mark.parametrize("goal", [0, 1])
def test_arriving_pays(goal: int) -> None:
    now, towards = tables(ARRIVE, goal), ((UP, DOWN), (DOWN, UP))[goal]
    assert (now.reward[23, towards[0]], now.terminated[23, towards[0]]) == (100, True)
    assert (now.reward[23, towards[1]], now.terminated[23, towards[1]]) == (-1, True)
    np.testing.assert_array_equal(now.reward[17], [-100, -100, -1, -1])
    np.testing.assert_array_equal(now.reward[5], [-1] * 4)  # back at the start
    assert not now.terminated[17].any() and not now.terminated[5].any()


def test_an_ordinary_goal_is_walked_through() -> None:
    for cliff in (LEAVE_ORDINARY, ARRIVE_ORDINARY):
        now = tables(cliff, 0)
        np.testing.assert_array_equal(now.next_state[35], [23, 35, 34, 35])
        assert (now.reward[23, DOWN], now.terminated[23, DOWN]) == (-1, False)
        assert not now.terminated[35].any()
    np.testing.assert_array_equal(tables(LEAVE_ORDINARY, 0).reward[35], [-1] * 4)
    np.testing.assert_array_equal(tables(ARRIVE_ORDINARY, 0).reward[35], [-1, -1, -100, -1])


def test_other_rewards() -> None:
    cliff = CliffConfig(step_reward=-2.0, goal_reward=7.0, restart_reward=-5.0)
    now = tables(cliff, 1)
    assert [now.reward[state, 0] for state in (17, 35, 5, 11)] == [-2, 7, -5, -2]


def test_the_shortest_episodes() -> None:
    """Up, eleven times right, up: 13 moves. Arriving pays 12 (-1) + 100 = 88, leaving 13 (-1) + 100 = 87."""
    way = [UP, *[RIGHT] * 11, UP]
    for cliff, actions, total in ((ARRIVE, way, 88.0), (LEAVE, [*way, LEFT], 87.0)):
        world = Cliffworld(cliff, lambda _t: 0.0, seed=0)
        world.reset(0, 0)
        outcomes = live(world, actions)
        assert sum(outcome.reward for outcome in outcomes) == total
        assert [outcome.terminated for outcome in outcomes] == [False] * (len(actions) - 1) + [True]
        assert states(outcomes)[12] == 11


def test_a_fall_by_hand() -> None:
    for cliff, rewards in ((ARRIVE, [-100, -1, -1]), (LEAVE, [-1, -100, -1])):
        world = Cliffworld(cliff, lambda _t: 0.0, seed=0)
        world.reset(0, 0)
        outcomes = live(world, [RIGHT, UP, UP])
        assert states(outcomes) == [25, START, 12]
        assert [outcome.reward for outcome in outcomes] == rewards


def test_the_drift_says_which_goal_pays() -> None:
    assert [active_goal(drift) for drift in (-1.0, 0.0, 0.499, 0.5, 1.0)] == [0, 0, 0, 1, 1]
    world = Cliffworld(ARRIVE, lambda t: float(t >= 7), seed=0)
    for t, total in ((6, 100.0), (7, -1.0)):
        world.reset(0, 0)
        live(world, [UP, *[RIGHT] * 11])
        outcome = world.step(number(UP), t)
        assert (outcome.reward, outcome.terminated, outcome.drift) == (total, True, float(t >= 7))


def test_the_switch_reaches_an_episode_under_way() -> None:
    world = Cliffworld(LEAVE, float, seed=0)
    world.reset(0, 0)
    live(world, [UP, *[RIGHT] * 11, UP], t=0)
    assert world.step(number(UP), 1).reward == -1.0  # in (11, 0), which paid until now


def test_what_is_drawn(tmp_path: Path) -> None:
    world = Cliffworld(LEAVE, float, seed=0)
    world.reset(0, 0)
    np.testing.assert_array_equal(world.position(), [0, 2, 11, 0])
    live(world, [UP, RIGHT], t=1)
    np.testing.assert_array_equal(world.position(), [1, 1, 11, 2])
    path = tmp_path / "world.mjb"
    world.save_scene(path)
    board = load_board(board_path(path))
    assert board.size == (12, 3)
    assert board.rows[2][0] == "S" and [board.rows[y][11] for y in range(3)] == ["G", ".", "G"]
    sends_back = [12 * y + x for y in range(3) for x in range(12) if board.rows[y][x] == "R"]
    assert sends_back == RESTARTS


def test_an_action_counts_as_the_nearest_number() -> None:
    world = Cliffworld(LEAVE, lambda _t: 0.0, seed=0)
    for action, expected in ((0.4, 12), (2.6, 25), (-3.0, 12), (9.0, 25)):
        world.reset(0, 0)
        assert states([world.step(number(action), 0)]) == [expected]


def test_spaces() -> None:
    world: World = Cliffworld(LEAVE, lambda _t: 0.0, seed=0)
    assert (world.states, world.actions, world.observation_dim, world.action_dim) == (36, 4, 1, 1)
    assert (world.action_low.tolist(), world.action_high.tolist()) == ([0.0], [3.0])
    assert world.native_period_s is None and world.physics_step_s is None
