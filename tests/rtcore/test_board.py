"""A board is read as it was written, or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcore.board import Board, load_board, save_board


def test_a_board_is_read_as_it_was_saved(tmp_path: Path) -> None:
    board = Board(rows=["S.G", "RR."])
    save_board(board, tmp_path / "world.mjb")
    assert [path.name for path in tmp_path.iterdir()] == ["world.json"]
    assert load_board(tmp_path / "world.mjb") == board
    assert board.size == (3, 2)


def test_no_file_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"world\.json is not there"):
        load_board(tmp_path / "world.mjb")


@pytest.mark.parametrize(
    "content",
    [
        "no json",
        "{}",
        '{"rows":[]}',
        '{"rows":[""]}',
        '{"rows":["S","S."]}',
        '{"rows":["S?"]}',
        '{"rows":["S\\n"]}',
    ],
)
def test_what_is_no_board_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "world.json").write_text(content)
    with pytest.raises(ValueError, match=r"world\.json"):
        load_board(tmp_path / "world.mjb")
