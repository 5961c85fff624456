"""The recording on the disk: grows by whole pieces, and leaves out what the disk does not take.

Rerun's own file sink (0.41) never writes again after one write that failed, and neither its flush nor its end
return (measured: longer than 35 s). So Rerun only encodes, and the file is written here.
"""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from recorder.finish import MAGIC, files_of, set_aside
from recorder.frames import END, MESSAGE_HEAD, STREAM_HEAD
from recorder.place import Kept, Place, PlaceFile
from rtcore.clock import Clock

RETRY_NS = 5_000_000_000


def unframed(rrd: bytes) -> tuple[bytes, bytes]:
    """The head, and the messages without the end, of a whole recording as Rerun (0.41) encodes one.

    See `recorder.frames` for what becomes of messages without an end.

    Raises:
        ValueError: this is no recording, or torn.
    """
    if rrd[: len(MAGIC)] != MAGIC:
        raise ValueError(f"no recording begins with {rrd[: len(MAGIC)]!r}")
    at = STREAM_HEAD
    while at < len(rrd):
        if at + MESSAGE_HEAD.size > len(rrd):
            raise ValueError("a recording is torn")
        kind, length = MESSAGE_HEAD.unpack_from(rrd, at)
        if kind == END:
            break
        at += MESSAGE_HEAD.size + length
    if at > len(rrd):
        raise ValueError("a recording is torn")
    return rrd[:STREAM_HEAD], rrd[STREAM_HEAD:at]


class RecordingFile:
    """A recording's file and its place. Constructing one touches nothing; `resume` and `append` do.

    Attributes:
        place: how far the recording has got; where an earlier life ended, until the first `append`.
        trouble: why the disk takes nothing at present; empty: it does.
        unplaced: why the place is not kept; empty: it is.
        unread: why it is not known how far what is there had got; empty: it is, or nothing is there.
        part: where that which earlier lives wrote lies until the end; None: there was none.
    """

    def __init__(self, path: Path, place_path: Path, clock: Clock, num_envs: int = 1) -> None:
        self._path = path
        self._clock = clock
        self._place_file = PlaceFile(place_path, num_envs)
        self._earlier: Kept | None = None
        self._file: int | None = None
        self._length = 0
        self._retry_ns = 0
        self.place = Place()
        self.trouble = self.unplaced = self.unread = ""
        self.part: Path | None = None

    def resume(self) -> None:
        """Go on where an earlier life of the recorder ended, if there was one."""
        self._earlier = self._place_file.read()
        if self._earlier is not None:
            self.place = self._earlier.place
        else:
            with suppress(OSError):  # then nothing can be written either, which is told
                self.unread = self._place_file.unread if files_of(self._path) else ""

    def append(self, data: bytes, place: Place) -> bool:
        """Write a piece, whole or not at all, up to this place. Never waits: after a failure there is no new
        attempt for 5 s.

        Returns:
            Whether the recording has it.
        """
        written = not data
        if data and self._clock.now_ns() >= self._retry_ns:
            written = self._try(data)
        self.place = place
        self._keep_place()
        return written

    def insist(self) -> None:
        """Have the next `append` make an attempt, however new the last failure is."""
        self._retry_ns = 0

    def close(self) -> None:
        """Let the files go. A second close does nothing."""
        self._place_file.close()
        if self._file is not None:
            with suppress(OSError):
                os.close(self._file)
            self._file = None

    def _try(self, data: bytes) -> bool:
        try:
            if self._file is None:
                self._file = self._opened()
            _write_all(self._file, data, self._length)
        except OSError as error:
            self.trouble = error.strerror or str(error)
            self._retry_ns = self._clock.now_ns() + RETRY_NS
            if self._file is not None:
                with suppress(OSError):  # then the next piece is written over it
                    os.ftruncate(self._file, self._length)
            return False
        self._length += len(data)
        self.trouble = ""
        return True

    def _opened(self) -> int:
        """The new file, after the place says that nothing of it counts yet."""
        earlier = self._earlier
        counts = None if earlier is None else (earlier.inode, earlier.length)
        self.part = set_aside(self._path, counts) or self.part  # an attempt before this one may have done it
        file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        self._keep_place(file)
        return file

    def _keep_place(self, file: int | None = None) -> None:
        file = self._file if file is None else file
        if file is None:
            return  # what is there is still what the earlier life wrote, and so is its place
        try:
            self._place_file.keep(Kept(os.fstat(file).st_ino, self._length, self.place))
        except OSError as error:
            self.unplaced = error.strerror or str(error)
        else:
            self.unplaced = ""


def _write_all(file: int, data: bytes, offset: int) -> None:
    """Write `data` at `offset`.

    Raises:
        OSError: not all of it was written.
    """
    rest = memoryview(data)
    while rest:
        written = os.pwrite(file, rest, offset)
        if not written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        rest, offset = rest[written:], offset + written
