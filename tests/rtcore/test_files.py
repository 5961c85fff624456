"""A file that is written once."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcore.files import write_once


def test_the_second_writer_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_once(path, b"one")
    with pytest.raises(FileExistsError):
        write_once(path, b"two")
    assert path.read_bytes() == b"one"
    assert list(tmp_path.iterdir()) == [path]


def test_where_it_cannot_be_written_nothing_is_left(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_once(tmp_path / "none" / "file", b"one")
    assert list(tmp_path.iterdir()) == []
