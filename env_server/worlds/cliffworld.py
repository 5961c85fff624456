"""The cliffworld whose goal switches (paper, section "Goal switching cliffworld" and its appendix).

    y=0   . R R R R R R R R R R G       G: the goals, (11, 0) and (11, 2)
    y=1   . . . . . . . . . . . .       R: sends back to the start
    y=2   S R R R R R R R R R R G       S: the start, (0, 2); "up" lowers y

What the paper leaves open is in `CliffConfig`. In every reading a cell has one reward, and a restart cell
takes a step of its own, whatever the action, to bring the agent back to the start. With `pays = "arrive"`
a step earns the reward of the cell that it leads to, and the episode ends on arrival. With "leave" it
earns that of the cell it leaves; from a cell that ends the episode any action does so, and leads nowhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from env_server.worlds.finite import FiniteWorld, Floats, Tables
from env_server.worlds.world import Position
from rtcore.board import Board, save_board
from rtcore.config import CliffConfig

COLUMNS, ROWS = 12, 3
STATES = COLUMNS * ROWS  # cell (x, y) is state 12 y + x
MOVES = ((0, -1), (0, 1), (-1, 0), (1, 0))  # (x, y) of the actions up, down, left, right
GOALS = (11, 35)  # (11, 0) and (11, 2)
START = 24  # (0, 2)
BOARD = Board(rows=[".RRRRRRRRRRG", "............", "SRRRRRRRRRRG"])
SWITCH = 0.5  # the drift's value from which on the second goal pays; below it the first does


@dataclass(frozen=True)
class Rules:
    """The world with one goal active, each by state and action.

    Attributes:
        next_state: int64 [36, 4].
        reward: float64 [36, 4].
        terminated: bool [36, 4].
    """

    next_state: NDArray[np.int64]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]


def tables(cliff: CliffConfig, goal: int) -> Rules:
    """The world while goal number `goal`, 0 or 1, is active; the other is as `cliff.inactive_goal` says."""
    cells = "".join(BOARD.rows)
    earns = np.full(STATES, cliff.step_reward)
    earns[[cell == "R" for cell in cells]] = cliff.restart_reward
    earns[GOALS[goal]] = cliff.goal_reward
    ends = np.zeros(STATES, np.bool_)
    ends[list(GOALS) if cliff.inactive_goal == "terminal" else GOALS[goal]] = True

    next_state = np.array([[_moved(state, move) for move in MOVES] for state in range(STATES)])
    next_state[[cell == "R" for cell in cells]] = START
    if cliff.pays == "arrive":
        return Rules(next_state, earns[next_state], ends[next_state])
    next_state[ends] = np.flatnonzero(ends)[:, None]
    return Rules(next_state, *(np.repeat(of_cell[:, None], len(MOVES), 1) for of_cell in (earns, ends)))


def active_goal(drift: float) -> int:
    """The number of the goal that pays at this value of the drift.

    The paper does not say which of the two is first; here it is (11, 0), which it names first.
    """
    return int(drift >= SWITCH)


class Cliffworld(FiniteWorld):
    """The `cliffworld` world: the cell's number in, one of up, down, left and right out.

    Nothing in it is random.
    """

    scene = "grid"

    def __init__(self, cliff: CliffConfig, drift: Callable[[int], float], *, seed: int) -> None:
        """`drift` gives the value in unit t that `active_goal` reads."""
        super().__init__(states=STATES, actions=len(MOVES), drift=drift, seed=seed)
        self._rules = [tables(cliff, goal) for goal in range(len(GOALS))]
        self._goal = 0

    def tables(self, t: int) -> Tables:
        """R_t and P_t of the 36 cells and the end, [37, 4] and [37, 4, 37]."""
        return _with_end(self._rules[active_goal(self.drift(t))])

    def starts(self) -> Floats:
        """Always (0, 2)."""
        at: Floats = (np.arange(STATES + 1) == START).astype(np.float64)
        return at

    def start(self, drift: float) -> int:
        """Always (0, 2)."""
        self._goal = active_goal(drift)
        return START

    def transition(self, state: int, action: int, drift: float) -> tuple[int, float, bool]:
        """As the tables of the active goal have it."""
        self._goal = active_goal(drift)
        now, at = self._rules[self._goal], (state, action)
        return int(now.next_state[at]), float(now.reward[at]), bool(now.terminated[at])

    def position(self) -> Position:
        """float64 [4]: x and y of the agent, and of the active goal."""
        return np.array([*_place(self.state), *_place(GOALS[self._goal])], np.float64)

    def save_scene(self, path: Path, /) -> None:
        """Write the board, as JSON beside `path`."""
        save_board(BOARD, path)


def _with_end(rules: Rules) -> Tables:
    """What terminates leads to the end instead of to a cell."""
    following = np.full((STATES + 1, len(MOVES)), STATES)
    following[:STATES] = np.where(rules.terminated, STATES, rules.next_state)
    reward = np.zeros(following.shape)
    reward[:STATES] = rules.reward
    return Tables(reward, np.eye(STATES + 1)[following])


def _place(state: int) -> tuple[int, int]:
    """(x, y) of a cell."""
    return state % COLUMNS, state // COLUMNS


def _moved(state: int, move: tuple[int, int]) -> int:
    """The cell that a move leads to on open ground; against the edge it leads nowhere."""
    x, y = (a + b for a, b in zip(_place(state), move, strict=True))
    return COLUMNS * y + x if 0 <= x < COLUMNS and 0 <= y < ROWS else state
