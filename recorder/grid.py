"""A board in 3-D: its cells, and the piece that moves on it.

Column x of the board is x in the world and row y is -y, so that row 0 is the far one; a cell is a metre wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from recorder.rows import Floats, Poses, Singles
from recorder.scene import FOLLOW, ROOT, Camera, Shape
from rtcore.board import GOAL, RESTART, SAFE, START, Board, load_board

PIECE, PAYING = f"{ROOT}/agent", f"{ROOT}/goal"
HALF_M = 0.47  # of a cell's side: the gaps between cells draw the grid
RADIUS_M = 0.3
POST_M = 0.9
PIECE_COLOUR, PAYING_COLOUR = [255, 162, 58], [255, 224, 102]
# Height of the top in metres, and colour: the cells that send back lie below the others.
LOOKS = {
    SAFE: (0.0, [92, 100, 114]),
    START: (0.0, [78, 155, 255]),
    GOAL: (0.0, [62, 207, 142]),
    RESTART: (-0.25, [122, 44, 48]),
}
NAMES = {SAFE: "cells", START: "start", GOAL: "goals", RESTART: "restarts"}
THICK_M = 0.1


class GridScene:
    """A board, the agent as a ball, and a post in the goal that pays.

    A position is float64 [4]: the agent's column and row, then those of the goal that pays.
    """

    def __init__(self, board: Board) -> None:
        self._board = board
        columns, rows = board.size
        self._tops = np.array([[LOOKS[cell][0] for cell in row] for row in board.rows], np.float32)
        self._middle = ((columns - 1) / 2, -(rows - 1) / 2, 0.0)
        across = max(columns, 2.0 * rows)
        self.camera = Camera((0.0, -0.6 * across, 0.85 * across), (0.0, -0.04 * across, 0.0))

    @classmethod
    def load(cls, world_path: Path) -> GridScene:
        """Read the board that the env server saved.

        Raises:
            OSError: it is not there.
            ValueError: it is no board.
        """
        return cls(load_board(world_path))

    def shapes(self) -> list[Shape]:
        """An entity per kind of cell, the ball, the post, and the view's frame, which stays in the middle."""
        ball = rr.Ellipsoids3D(half_sizes=[[RADIUS_M] * 3], colors=[PIECE_COLOUR], fill_mode="solid")
        post = rr.Cylinders3D(lengths=[POST_M], radii=[0.12], colors=[PAYING_COLOUR], fill_mode="solid")
        cells = [self._cells(kind) for kind in LOOKS if any(kind in row for row in self._board.rows)]
        frame = Shape(FOLLOW, rr.Transform3D(translation=self._middle))
        return [*cells, Shape(PIECE, ball), Shape(PAYING, post), frame]

    def fits(self, numbers: float) -> bool:
        """Two cells."""
        return numbers == 4

    def poses(self, positions: Sequence[Floats]) -> dict[str, Poses]:
        """The ball on its cell, and the post on the cell that pays."""
        places = np.array(positions, np.float32).reshape(-1, 4)
        return {
            PIECE: Poses(self._on_top(places[:, :2], RADIUS_M)),
            PAYING: Poses(self._on_top(places[:, 2:], POST_M / 2)),
        }

    def _cells(self, kind: str) -> Shape:
        top_m, colour = LOOKS[kind]
        centers = [
            [x, -y, top_m - THICK_M / 2]
            for y, row in enumerate(self._board.rows)
            for x, cell in enumerate(row)
            if cell == kind
        ]
        boxes = rr.Boxes3D(
            centers=centers,
            half_sizes=[[HALF_M, HALF_M, THICK_M / 2]] * len(centers),
            colors=[colour] * len(centers),
            fill_mode="solid",
        )
        return Shape(f"{ROOT}/board/{NAMES[kind]}", boxes)

    def _on_top(self, cells: Singles, height_m: float) -> Singles:
        """float32 [n, 3]: so far above the cells [n, 2], each a column and a row."""
        columns, rows = self._board.size
        x, y = cells[:, 0], cells[:, 1]
        nearest = (
            np.clip(np.rint(y), 0, rows - 1).astype(int),
            np.clip(np.rint(x), 0, columns - 1).astype(int),
        )
        return np.column_stack([x, -y, self._tops[nearest] + np.float32(height_m)])
