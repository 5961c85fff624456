"""How far a recording has got, kept in a file beside it, so that a later life of the recorder goes on there.

The place is written after each piece of the recording, and says how long the recording then was. Whatever
lies beyond that length was written by a life that was killed before it could say so: it is cut off, and what
it was made from is taken from the env server's log once more. So every row is there once.

The file has two slots, written by turns: generation, length and CRC-32 of the rest, and the place in msgpack.
A kill -9 in the midst of a write leaves the other slot. The kernel has what was written whatever becomes of
the process; nothing here waits for the disk.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import msgspec

from recorder.seen import SeenMark

SLOT_BYTES = 32_768  # five processes with 256 events each, and 256 window notices, are 25 kB ...
ENV_BYTES = 12_288  # ... and two more, with what else a further environment brings, 10 kB
_HEAD = struct.Struct("<QII")


class Carried(msgspec.Struct, frozen=True, array_like=True):
    """What the rows of the next step take from the last one, which `incarnation` and `seq` name."""

    incarnation: int
    seq: int
    first: float  # its first coordinate in metres; NaN: none, or nobody needs it
    episode_return: float | None  # so far; None: a step of this episode never came


class Told(msgspec.Struct, frozen=True, array_like=True):
    """What of the telemetry is in the recording; see `recorder.seen`."""

    stats: dict[str, SeenMark] = {}
    events: dict[str, SeenMark] = {}
    notices: SeenMark = SeenMark()
    policies: SeenMark = SeenMark()
    forecast_names: list[str] = []


class EnvPlace(msgspec.Struct, frozen=True, array_like=True):
    """How far a recording has got with one environment.

    Attributes:
        log: (incarnation, seq) of the next step of the env server's log; None: none came yet.
        carried: from the last step; None: there is none.
        episodes: (number, run time in ns of its first step) of the newest ones.
    """

    log: tuple[int, int] | None = None
    carried: Carried | None = None
    episodes: list[tuple[int, int]] = []


START = EnvPlace()


class Place(msgspec.Struct, frozen=True, array_like=True):
    """How far a recording has got, with all environments at the same length of the file.

    Attributes:
        envs: by the environment's name; those that nothing is written of yet may be missing.
        placements: process -> what the system granted it.
    """

    envs: dict[str, EnvPlace] = {}
    placements: dict[str, str] = {}
    told: Told = Told()


class Kept(msgspec.Struct, frozen=True, array_like=True):
    """A place, and the file that it is of: `inode` at `length` bytes has all rows up to it and no others."""

    inode: int
    length: int
    place: Place


class PlaceFile:
    """The file of the place, of a run with so many environments. Constructing one touches nothing.

    Attributes:
        unread: why `read` found nothing; empty: it did.
    """

    def __init__(self, path: Path, num_envs: int = 1) -> None:
        self._path = path
        self._slot_bytes = SLOT_BYTES + (num_envs - 1) * ENV_BYTES
        self._file: int | None = None
        self._generation = 0
        self.unread = ""

    def read(self) -> Kept | None:
        """What an earlier life kept; None if there was none, or if nobody can tell."""
        try:
            data = self._path.read_bytes()
        except OSError as error:
            self.unread = error.strerror or str(error)
            return None
        found = dict(_whole(data, self._slot_bytes))
        if not found:
            self.unread = "damaged, or of another version"
            return None
        self._generation = max(found)
        return found[self._generation]

    def keep(self, kept: Kept) -> None:
        """Write it down, in place of the one before the last.

        Raises:
            OSError: it is not written; the last one is as it was.
        """
        payload = msgspec.msgpack.encode(kept)
        if len(payload) > self._slot_bytes - _HEAD.size:
            raise OSError(errno.EFBIG, f"{len(payload)} bytes are too many for a place")
        if self._file is None:
            self._file = self._opened()
        generation = self._generation + 1
        head = _HEAD.pack(generation, len(payload), _check(generation, payload))
        offset = generation % 2 * self._slot_bytes
        if os.pwrite(self._file, head + payload, offset) < len(head) + len(payload):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._generation = generation

    def close(self) -> None:
        """Let the file go. A second close does nothing."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _opened(self) -> int:
        file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            os.posix_fallocate(file, 0, 2 * self._slot_bytes)  # a disk that gets full later has room for it
        except OSError:
            os.close(file)
            raise
        return file


def _check(generation: int, payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(generation.to_bytes(8, "little")))


def _whole(data: bytes, slot_bytes: int) -> Iterator[tuple[int, Kept]]:
    """Generation and content of the slots that are whole."""
    for offset in (0, slot_bytes):
        if len(data) < offset + _HEAD.size:
            return
        generation, length, check = _HEAD.unpack_from(data, offset)
        payload = data[offset + _HEAD.size :][: min(length, slot_bytes - _HEAD.size)]
        if generation == 0 or len(payload) != length or _check(generation, payload) != check:
            continue
        try:
            yield generation, msgspec.msgpack.decode(payload, type=Kept)
        except msgspec.DecodeError:  # of another version of this program
            continue
