"""What cannot be compacted is made one file all the same, or left as it is: in time, and without a loss."""

from __future__ import annotations

import errno
import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from recorder import finish, frames
from recorder.finish import FinishError
from recorder.frames import MESSAGE_HEAD

HEAD, ROWS = finish.MAGIC + bytes(8), 2
EARLIER, LATER = MESSAGE_HEAD.pack(ROWS, 7) + b"earlier", MESSAGE_HEAD.pack(ROWS, 5) + b"later"


def two_files(directory: Path) -> tuple[Path, Path]:
    """A recording of one message, and a part of it of another."""
    path, part = directory / "recording.rrd", directory / "recording.part000.rrd"
    path.write_bytes(HEAD + LATER)
    part.write_bytes(HEAD + EARLIER)
    return path, part


@pytest.mark.parametrize(
    ("failure", "why"),
    [
        (FinishError("rerun rrd optimize failed (-9): no output"), r"failed \(-9\)"),  # killed for memory
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "Cannot allocate memory"),
    ],
)
def test_the_parts_are_joined_whatever_kept_them_from_being_compacted(
    failure: Exception, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(arguments: Sequence[str], *, timeout_s: float, home_in: Path) -> str:
        (home_in / "recording.rrd").write_bytes(finish.MAGIC + bytes(1000))  # it was half done
        raise failure

    monkeypatch.setattr(finish, "run_cli", fail)
    path, _ = two_files(tmp_path)
    with pytest.raises(FinishError, match=why):
        finish.finish(path)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == HEAD + EARLIER + LATER


def test_without_the_time_to_join_them_they_stay_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(finish, "LEAST_JOIN_S", -1.0)
    path, part = two_files(tmp_path)
    assert finish.main(["--within-s", "0", str(path)]) == 1
    assert capsys.readouterr().err == "there was not even the time to join 0 MB; it is in 2 files\n"
    assert sorted(tmp_path.iterdir()) == [part, path]
    assert (part.read_bytes(), path.read_bytes()) == (HEAD + EARLIER, HEAD + LATER)


@pytest.mark.parametrize(
    ("due_s", "copied", "failure", "why"),
    [(2.5, 3, TimeoutError, "not in time"), (9.0, 0, ValueError, r"part000\.rrd got shorter")],
)
def test_joining_ends_in_time_and_amid_a_file_that_gets_shorter(
    due_s: float,
    copied: int,
    failure: type[Exception],
    why: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s, sendfile = [0.0], os.sendfile

    def slow(out: int, file: int, offset: int, count: int) -> int:
        now_s[0] += 1.0  # a chunk a second
        return sendfile(out, file, offset, count) if copied else 0

    monkeypatch.setattr(frames, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    monkeypatch.setattr(frames, "COPIED_BYTES", 4)
    monkeypatch.setattr(os, "sendfile", slow)
    path, part = two_files(tmp_path)
    with pytest.raises(failure, match=why):
        frames.join([part, path], tmp_path / "joined", due_s)
    assert (tmp_path / "joined").stat().st_size == 4 * copied


def test_the_search_for_the_end_is_in_time_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looks = itertools.count()  # one a second
    monkeypatch.setattr(frames, "time", SimpleNamespace(monotonic=lambda: float(next(looks))))
    path, _ = two_files(tmp_path)
    path.write_bytes(HEAD + 10 * LATER)
    frames.join([path], tmp_path / "joined", 10.0)  # ten messages, and one copy
    with pytest.raises(TimeoutError):
        frames.join([path], tmp_path / "joined", 20.0)


def test_nothing_is_left_out_because_of_a_damage_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(finish, "CLI", "import sys; sys.exit('it is broken')")
    path, part = two_files(tmp_path)
    part.write_bytes(HEAD + EARLIER + MESSAGE_HEAD.pack(1 << 40, 3) + b"abc" + EARLIER)
    before = part.read_bytes()
    with pytest.raises(FinishError, match=rf"part000\.rrd is damaged at byte {len(HEAD + EARLIER)}"):
        finish.finish(path)
    assert (part.read_bytes(), path.read_bytes()) == (before, HEAD + LATER)
    assert sorted(tmp_path.iterdir()) == [part, path]
