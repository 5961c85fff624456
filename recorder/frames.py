"""The frame of a recording's file, as Rerun (0.41) writes one: a head, messages, and perhaps an end.

Messages of several recordings, one after the other behind the head of the first, are a recording without an
end, as a process that was killed leaves it: `recorder.finish` adds it.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

STREAM_HEAD = 12  # bytes: magic, version, options
MESSAGE_HEAD = struct.Struct("<QQ")  # kind, length of what follows
END, LAST_KIND = 0, 3  # the others are: a recording begins, rows, a layout is shown
COPIED_BYTES = 64 << 20  # between two looks at the clock


def join(sources: Sequence[Path], into: Path, due_s: float) -> None:
    """Write the messages of all sources into one file, in their order; what is torn at an end is left out.

    It is copied and not understood: as fast as the disk, whatever the size.

    Args:
        sources: recordings, none of them empty.
        into: the file.
        due_s: when it must be done, on the monotonic clock.

    Raises:
        TimeoutError: it was not.
        OSError: the disk does not take it.
        ValueError: the sources are not written alike, or one is damaged.
    """
    first = b""
    with into.open("wb") as out:
        for i, source in enumerate(sources):
            with source.open("rb") as file:
                head = file.read(STREAM_HEAD)
                if i == 0:
                    first = head
                elif head != first:
                    raise ValueError(f"{source.name} is not written as {sources[0].name} is")
                begin, end = (0 if i == 0 else STREAM_HEAD), _end_of_messages(file, due_s)
                _copy(file, out, begin, end, due_s)


def _copy(file: BinaryIO, out: BinaryIO, begin: int, end: int, due_s: float) -> None:
    at = begin
    while at < end:
        _look_at_the_clock(due_s)
        copied = os.sendfile(out.fileno(), file.fileno(), at, min(COPIED_BYTES, end - at))
        if not copied:
            raise ValueError(f"{Path(file.name).name} got shorter while it was copied")
        at += copied


def _look_at_the_clock(due_s: float) -> None:
    if time.monotonic() > due_s:
        raise TimeoutError("not in time")


def _end_of_messages(file: BinaryIO, due_s: float) -> int:
    """Where the last whole message ends; an end is none."""
    size = os.fstat(file.fileno()).st_size
    at = STREAM_HEAD
    while at + MESSAGE_HEAD.size <= size:
        _look_at_the_clock(due_s)
        file.seek(at)
        kind, length = MESSAGE_HEAD.unpack(file.read(MESSAGE_HEAD.size))
        if kind > LAST_KIND:  # not torn: what follows may be whole, and must not be left out
            raise ValueError(f"{Path(file.name).name} is damaged at byte {at}")
        if kind == END or at + MESSAGE_HEAD.size + length > size:
            break
        at += MESSAGE_HEAD.size + length
    return at
