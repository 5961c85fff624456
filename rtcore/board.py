"""A board of cells, as a world that lives on one writes it for whoever draws it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from rtcore.files import write_atomic

SAFE, START, GOAL, RESTART = ".", "S", "G", "R"


class Board(msgspec.Struct, frozen=True):
    """What each cell is.

    Attributes:
        rows: equally long; `rows[y][x]` is the cell in column x of row y: "." to walk on, "S" where episodes
            begin, "G" a goal, "R" a cell that sends back to the start.
    """

    rows: Annotated[list[Annotated[str, msgspec.Meta(pattern=r"^[.SGR]+\Z")]], msgspec.Meta(min_length=1)]

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return len(self.rows[0]), len(self.rows)


def board_path(world_path: Path) -> Path:
    """`world.json`, beside where a MuJoCo model would be."""
    return world_path.with_suffix(".json")


def save_board(board: Board, world_path: Path) -> None:
    """Write it.

    Raises:
        OSError: it cannot be written.
    """
    write_atomic(board_path(world_path), msgspec.json.format(msgspec.json.encode(board)) + b"\n")


def load_board(world_path: Path) -> Board:
    """Read it.

    Raises:
        OSError: it is not there.
        ValueError: it is no board.
    """
    path = board_path(world_path)
    if not path.is_file():
        raise FileNotFoundError(f"{path.name} is not there")
    try:
        board = msgspec.json.decode(path.read_bytes(), type=Board)
    except msgspec.MsgspecError as error:
        raise ValueError(f"{path.name}: {error}") from error
    if len({len(row) for row in board.rows}) != 1:
        raise ValueError(f"{path.name}: its rows are not equally long")
    return board
