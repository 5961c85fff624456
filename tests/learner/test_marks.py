"""Marks against a writer that is killed at any byte, and against a host that ends."""

from __future__ import annotations

from pathlib import Path

import pytest

from learner.marks import Marks, MarksError, Record, pack, peek, unpack

SHAPE = {"schema": 3, "capacity": 4}
ROOM = 40


def record(number: int) -> Record:
    return Record(added=number, oldest=number // 2, note=b"n" * (number % ROOM), boot="b", until=number + 9)


def test_a_record_comes_back() -> None:
    assert unpack(pack(record(7), 3)) == (3, record(7))
    assert unpack(pack(Record(), 0) + b"rest") == (0, Record())


def test_a_record_with_any_byte_changed_is_not_whole() -> None:
    data = pack(record(7), 3)
    for index in range(len(data)):
        assert unpack(data[:index]) is None
        changed = bytearray(data)
        changed[index] ^= 1
        assert unpack(bytes(changed)) is None, index


def test_the_newest_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "marks.bin"
    assert Marks.open(path, SHAPE, ROOM).newest == Record()
    for number in range(1, 6):
        Marks.open(path, SHAPE, ROOM).write(record(number))
        assert Marks.open(path, SHAPE, ROOM).newest == record(number)


def test_anybody_may_look_at_marks_of_whatever_shape(tmp_path: Path) -> None:
    path = tmp_path / "marks.bin"
    assert peek(path) is None
    marks = Marks.open(path, SHAPE, ROOM)
    for number in range(4):
        marks.write(record(number))
        assert peek(path) == record(number)
    path.write_bytes(path.read_bytes()[:500])
    assert peek(path) is None


def test_cut_off_at_any_byte_there_is_the_new_one_or_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "marks.bin"
    marks = Marks.open(path, SHAPE, ROOM)
    for number in range(1, 4):
        marks.write(record(number))
    before = path.read_bytes()
    marks.write(record(4))
    after = path.read_bytes()
    changed = [at for at, (old, new) in enumerate(zip(before, after, strict=True)) if old != new]
    for kept in range(len(changed) + 1):
        torn = bytearray(before)
        for at in changed[:kept]:
            torn[at] = after[at]
        path.write_bytes(torn)
        newest = Marks.open(path, SHAPE, ROOM).newest
        assert newest == (record(4) if kept == len(changed) else record(3))


def test_a_note_that_is_too_long_changes_nothing(tmp_path: Path) -> None:
    marks = Marks.open(tmp_path / "marks.bin", SHAPE, ROOM)
    marks.write(record(5))
    with pytest.raises(ValueError, match="41 bytes: at most 40"):
        marks.write(Record(note=b"n" * 41))
    assert marks.newest == Marks.open(tmp_path / "marks.bin", SHAPE, ROOM).newest == record(5)


def test_other_shapes_and_damage_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "marks.bin"
    Marks.open(path, SHAPE, ROOM)
    with pytest.raises(MarksError, match=r"schema 3 \(wanted 4\), capacity 4 \(wanted 5\)$"):
        Marks.open(path, {"schema": 4, "capacity": 5}, ROOM)
    with pytest.raises(MarksError, match=r"envs 1 \(wanted 2\)$"):  # before the size that follows from it
        Marks.open(path, SHAPE | {"envs": 2}, 2 * ROOM)
    with pytest.raises(MarksError, match="bytes"):
        Marks.open(path, SHAPE, ROOM + 1)
    path.write_bytes(path.read_bytes()[:512] + bytes(path.stat().st_size - 512))
    with pytest.raises(MarksError, match="neither record is whole"):
        Marks.open(path, SHAPE, ROOM)
    path.write_bytes(b"?" * path.stat().st_size)
    with pytest.raises(MarksError, match="not readable"):
        Marks.open(path, SHAPE, ROOM)
