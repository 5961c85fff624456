"""The recording and a disk that is full, or may not be written to. Real file systems, small ones."""

from __future__ import annotations

import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rerun as rr

from recorder import reading
from recorder.disk import RETRY_NS, RecordingFile, unframed
from recorder.finish import MAGIC, parts_of
from recorder.place import EnvPlace, Kept, Place, PlaceFile
from rtcore.clock import VirtualClock
from tests.recorder.stage import SPEC, Stage, come_back, make_step, set_stage

FULL = "the disk takes no rows: No space left on device; they are dropped and counted"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own, of 2 MB."""
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(tmp_path)]
    made = subprocess.run(mount, capture_output=True, text=True, check=False)
    if made.returncode != 0:
        pytest.skip(f"file systems cannot be mounted here: {made.stderr.strip()}")
    try:
        yield tmp_path
    finally:
        subprocess.run(["umount", "-l", str(tmp_path)], check=True)


def remount(directory: Path, how: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{how}", str(directory)], check=True)


def fill(directory: Path) -> Path:
    """Take all the room that is left."""
    path = directory / "ballast"
    with path.open("wb", buffering=0) as file:
        for size in (65_536, 4096, 1):
            try:
                while file.write(bytes(size)) == size:
                    pass
            except OSError:
                continue
    return path


def record(stage: Stage, *seqs: int) -> None:
    stage.steps([make_step(seq) for seq in range(*seqs)], size=10)
    stage.service.flush()


def at(seq: int) -> Place:
    return Place({"env0": EnvPlace((1, seq))})


def texts(stage: Stage) -> list[str]:
    return [event.text for event in stage.events()]


def test_a_full_disk_drops_rows_counts_them_and_takes_the_next_ones_when_it_has_room(
    small_disk: Path,
) -> None:
    stage = set_stage(small_disk)
    stage.spec.put(SPEC)
    record(stage, 60)
    before = stage.ledger.counter("rows")
    ballast = fill(small_disk)
    record(stage, 60, 160)  # 2 s, in two pieces
    assert texts(stage) == [FULL]
    assert stage.ledger.counter("rows") == before
    ballast.unlink()
    record(stage, 160, 210)  # there is room, but the last attempt was less than 5 s ago
    assert stage.ledger.counter("rows") == before
    stage.clock.advance_ns(RETRY_NS)
    stage.steps([make_step(seq) for seq in range(210, 260)], last=True)
    stage.service.close()
    dropped = stage.ledger.counter("disk_dropped")
    assert texts(stage) == [FULL, f"the disk takes rows again; {dropped} were dropped"]
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == [*range(60), *range(210, 260)]
    assert stage.ledger.counter("dropped") == dropped
    assert dropped == 150 * 9  # six series and two poses; a version but at a reset, a return at an end
    assert stage.ledger.counter("rows") == 110 * 9


def test_what_a_full_disk_did_not_take_is_not_written_by_a_later_life_either(small_disk: Path) -> None:
    """It has been counted as dropped."""
    stage = set_stage(small_disk)
    stage.spec.put(SPEC)
    record(stage, 60)
    ballast = fill(small_disk)
    record(stage, 60, 120)
    ballast.unlink()
    later = come_back(stage)
    later.steps([make_step(seq) for seq in range(180)], size=180, last=True)
    later.service.close()
    assert reading.columns(later.path, "/env/reward")[0].tolist() == [*range(60), *range(120, 180)]


def test_a_read_only_directory_costs_rows_but_not_the_looks(small_disk: Path) -> None:
    stage = set_stage(small_disk)
    stage.spec.put(SPEC)
    remount(small_disk, "ro")
    record(stage, 60)
    assert texts(stage) == ["the disk takes no rows: Read-only file system; they are dropped and counted"]
    assert not stage.path.exists()
    remount(small_disk, "rw")
    stage.clock.advance_ns(RETRY_NS)
    stage.steps([make_step(seq) for seq in range(60, 120)], last=True)
    stage.service.close()
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == list(range(60, 120))
    assert reading.series(stage.path, "/env/reward") != []
    assert reading.document(stage.path).startswith("# r1")
    assert rr.chunk.RrdReader(str(stage.path)).blueprints() != []


def test_a_directory_that_stays_read_only_ends_without_a_recording_and_says_so(small_disk: Path) -> None:
    stage = set_stage(small_disk)
    stage.spec.put(SPEC)
    remount(small_disk, "ro")
    record(stage, 60)
    stage.service.close()
    assert texts(stage)[1:] == [
        "the recording has what the disk took but stays as it was written: recording.rrd: nothing was written"
    ]
    assert stage.ledger.counter("rows") == 0
    assert stage.ledger.counter("dropped") == 60 * 9


def test_a_disk_that_is_full_at_the_end_leaves_the_recording_as_it_was_written(small_disk: Path) -> None:
    stage = set_stage(small_disk)
    stage.spec.put(SPEC)
    record(stage, 60)
    fill(small_disk)
    stage.service.close()
    (text,) = texts(stage)
    assert text.startswith("the recording has all rows but stays as it was written: ")
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == list(range(60))
    assert sorted(path.name for path in stage.path.parent.glob("*.rrd")) == ["recording.rrd"]
    assert not list(stage.path.parent.glob(".recording*"))


def test_a_piece_that_fits_in_part_is_taken_back(small_disk: Path) -> None:
    clock, path = VirtualClock(), small_disk / "recording.rrd"
    file = RecordingFile(path, small_disk / "place", clock)
    file.resume()
    assert file.append(b"a" * 1000, Place())
    assert not file.append(b"b" * 4_000_000, at(5))  # 2 MB of it would fit
    assert path.read_bytes() == b"a" * 1000
    assert not file.append(b"c" * 10, at(6))  # no attempt so soon
    clock.advance_ns(RETRY_NS)
    assert file.append(b"d" * 10, at(7))
    file.close()
    assert path.read_bytes() == b"a" * 1000 + b"d" * 10
    later = RecordingFile(path, small_disk / "place", clock)
    later.resume()
    assert later.place == at(7)


def test_a_new_file_counts_for_nothing_before_its_first_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, place_path, clock = tmp_path / "recording.rrd", tmp_path / "place", VirtualClock()
    first = RecordingFile(path, place_path, clock)
    assert first.append(b"a" * 10, at(1))
    first.close()
    keep, calls = PlaceFile.keep, []

    def killed(file: PlaceFile, kept: Kept) -> None:
        calls.append(kept)
        if len(calls) == 2:  # the first is that of the empty file
            raise KeyboardInterrupt
        keep(file, kept)

    monkeypatch.setattr(PlaceFile, "keep", killed)
    second = RecordingFile(path, place_path, clock)
    second.resume()
    with pytest.raises(KeyboardInterrupt):
        second.append(b"b" * 10, at(2))
    assert path.read_bytes() == b"b" * 10
    third = RecordingFile(path, place_path, clock)
    third.resume()
    assert third.place == at(1)
    assert third.append(b"c" * 10, at(2))
    assert path.read_bytes() == b"c" * 10
    assert [part.read_bytes() for part in parts_of(path)] == [b"a" * 10]


def test_where_earlier_lives_left_theirs_is_known_though_the_disk_refused_the_new_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, clock = tmp_path / "recording.rrd", VirtualClock()
    path.write_bytes(b"a" * 10)
    file, opened = RecordingFile(path, tmp_path / "place", clock), os.open

    def full(*arguments: Any) -> int:
        monkeypatch.setattr("recorder.disk.os.open", opened)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("recorder.disk.os.open", full)
    assert not file.append(b"b" * 10, Place())
    clock.advance_ns(RETRY_NS)
    assert file.append(b"c" * 10, Place())
    file.close()
    assert file.part == tmp_path / "recording.part000.rrd"
    assert (file.part.read_bytes(), path.read_bytes()) == (b"a" * 10, b"c" * 10)


def test_without_a_place_it_records_and_says_what_that_may_cost(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    (stage.run_dir.logs_dir / "recorder.place").mkdir()
    stage.spec.put(SPEC)
    stage.steps([make_step(seq) for seq in range(60)], last=True)
    stage.service.close()
    assert texts(stage) == [
        "rows may come twice if the recorder is killed: no place is kept: Is a directory",
    ]
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == list(range(60))


def test_messages_are_told_from_the_head_and_the_end() -> None:
    head = MAGIC + bytes(8)
    message = (2).to_bytes(8, "little") + (3).to_bytes(8, "little") + b"abc"
    end = bytes(8) + (1).to_bytes(8, "little") + b"x"
    assert unframed(head + message + message + end) == (head, message + message)
    assert unframed(head + message) == (head, message)
    assert unframed(head) == (head, b"")
    for torn in (head + message[:-1], head + message + message[:10]):
        with pytest.raises(ValueError, match="torn"):
            unframed(torn)
    with pytest.raises(ValueError, match="no recording begins with b'RRF3'"):
        unframed(b"RRF3" + bytes(8))
