"""Which rows of a ring in mapped files count, whatever became of the process that wrote them.

What a process has stored in a mapped file belongs to the kernel, so a kill -9 loses none of it; but it may
fall between any two stores. Two slots take turns: a record goes over the older one with its checksum, and of
those that are whole the newer one counts. Layout:

    0     the ring's shape as JSON, padded with spaces
    512   slot 0
    ...   slot 1

A record, little-endian: CRC-32 of what follows; its generation; `added`, `oldest`, `until`; the boot's name;
the note's length; the note.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

from rtcore.files import write_once

_HEADER_BYTES = 512
_HEAD = struct.Struct("<QQQQ36sI")
_CRC = struct.Struct("<I")


class MarksError(ValueError):
    """The marks are damaged, or of a ring of another shape: says every difference on one line."""


@dataclass(frozen=True, slots=True)
class Record:
    """What counts.

    Attributes:
        added: rows ever added; row number n lies at n modulo the ring's length.
        oldest: number of the oldest row that counts; all from there to `added` - 1 do.
        note: of the writer, committed together with the rows.
        boot: the boot of the host in which it was written; empty where the system has no name for it.
        until: of a record on the disk: rows up to this number may have been written since.
    """

    added: int = 0
    oldest: int = 0
    note: bytes = b""
    boot: str = ""
    until: int = 0


class Found(NamedTuple):
    """A whole record."""

    generation: int
    record: Record


def pack(record: Record, generation: int) -> bytes:
    """One record with its checksum."""
    boot = record.boot.encode()[:36]
    head = _HEAD.pack(generation, record.added, record.oldest, record.until, boot, len(record.note))
    body = head + record.note
    return _CRC.pack(zlib.crc32(body)) + body


def unpack(data: bytes) -> Found | None:
    """The record at the beginning of `data`; None if it is not whole."""
    begin = _CRC.size + _HEAD.size
    if len(data) < begin:
        return None
    generation, added, oldest, until, boot, length = _HEAD.unpack_from(data, _CRC.size)
    body = data[_CRC.size : begin + length]
    if len(body) != _HEAD.size + length or _CRC.unpack_from(data)[0] != zlib.crc32(body):
        return None
    name = boot.rstrip(b"\0").decode(errors="replace")
    return Found(generation, Record(added, oldest, bytes(body[_HEAD.size :]), name, until))


def read(path: Path) -> Record | None:
    """The record that counts, for anybody who asks, also while it is written; None if neither is whole.

    Raises:
        OSError: the file cannot be read.
    """
    data = path.read_bytes()[_HEADER_BYTES:]
    halves = (data[: len(data) // 2], data[len(data) // 2 :])
    found = [one for one in map(unpack, halves) if one is not None]
    return max(found, key=lambda one: one.generation).record if found else None


class Marks:
    """The two slots. One thread writes.

    Attributes:
        newest: the record that counts.
        room: bytes that a note may have.
    """

    def __init__(self, mapped: mmap.mmap, slot: int, found: Found) -> None:
        """Use `open`."""
        self._mapped = mapped
        self._slot = slot
        self._generation, self.newest = found
        self.room = slot - _CRC.size - _HEAD.size

    @classmethod
    def open(cls, path: Path, shape: dict[str, int], room: int) -> Self:
        """The marks in a file, which is made if there is none: then no row counts.

        Args:
            path: of the file.
            shape: of the ring. What is left out is 1.
            room: bytes that a note may have.

        Raises:
            MarksError: they are of another shape, or damaged.
            OSError: the file cannot be read or made.
        """
        slot = _CRC.size + _HEAD.size + room
        size = _HEADER_BYTES + 2 * slot
        if not path.exists():
            header = json.dumps(shape).encode().ljust(_HEADER_BYTES)
            write_once(path, header + pack(Record(), 0).ljust(slot, b"\0") + bytes(slot))
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            _require(path, os.pread(descriptor, _HEADER_BYTES, 0), shape)
            if os.fstat(descriptor).st_size != size:
                raise MarksError(f"{path}: {os.fstat(descriptor).st_size} bytes (wanted {size})")
            os.posix_fallocate(descriptor, 0, size)
            mapped = mmap.mmap(descriptor, size)
        finally:
            os.close(descriptor)
        slots = [unpack(mapped[at : at + slot]) for at in (_HEADER_BYTES, _HEADER_BYTES + slot)]
        whole = [found for found in slots if found is not None]
        if not whole:
            raise MarksError(f"{path}: neither record is whole")
        return cls(mapped, slot, max(whole, key=lambda found: found.generation))

    def write(self, record: Record) -> None:
        """Let `record` count from now on.

        Raises:
            ValueError: its note is too long; nothing has changed then.
        """
        if len(record.note) > self.room:
            raise ValueError(f"a note of {len(record.note)} bytes: at most {self.room}")
        self._generation += 1
        data = pack(record, self._generation)
        at = _HEADER_BYTES + self._slot * (self._generation % 2)
        self._mapped[at : at + len(data)] = data
        self.newest = record


def peek(path: Path) -> Record | None:
    """The record that counts in a file of marks of whatever shape; None if it cannot be told."""
    try:
        return read(path)
    except OSError:
        return None


def _require(path: Path, header: bytes, wanted: dict[str, int]) -> None:
    try:
        found = dict(json.loads(header))
    except (ValueError, TypeError) as error:
        raise MarksError(f"{path}: not readable ({error})") from None
    differences = [
        f"{key} {found.get(key, 1)} (wanted {wanted.get(key, 1)})"
        for key in found | wanted
        if found.get(key, 1) != wanted.get(key, 1)
    ]
    if differences:
        raise MarksError(f"{path.parent}: {', '.join(differences)}")
