"""Files that are there whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcore.files import sweep, write_atomic, write_once


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


def test_what_a_killed_writer_left_is_swept_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / ".hidden").write_bytes(b"")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(SystemExit))
        patch.setattr(Path, "unlink", lambda *_, **__: None)  # a process that is killed cleans nothing up
        with pytest.raises(SystemExit):
            write_atomic(tmp_path / "file", b"lost")
    assert len(list(tmp_path.iterdir())) == 2
    write_atomic(tmp_path / "file", b"whole")
    sweep(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hidden", "file"]
    sweep(tmp_path / "none")
