"""The frame of a recording's file, as Rerun (0.41) writes one: a head, messages, and perhaps an end.

Messages of several recordings, one after the other behind the head of the first, are a recording without an
end, as a process that was killed leaves it: `recorder.finish` adds it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

STREAM_HEAD = 12  # bytes: magic, version, options
MESSAGE_HEAD = struct.Struct("<QQ")  # kind, length of what follows
END = 0


def join(sources: Sequence[Path], into: Path) -> None:
    """Write the messages of all sources into one file, in their order; what is torn at an end is left out.

    It is copied and not understood: as fast as the disk, whatever the size.

    Raises:
        OSError: the disk does not take it.
        ValueError: the sources are not written alike.
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
                at, end = (0 if i == 0 else STREAM_HEAD), _end_of_messages(file)
                while at < end:
                    at += os.sendfile(out.fileno(), file.fileno(), at, end - at)


def _end_of_messages(file: BinaryIO) -> int:
    """Where the last whole message ends; an end is none."""
    size = os.fstat(file.fileno()).st_size
    at = STREAM_HEAD
    while at + MESSAGE_HEAD.size <= size:
        file.seek(at)
        kind, length = MESSAGE_HEAD.unpack(file.read(MESSAGE_HEAD.size))
        if kind == END or at + MESSAGE_HEAD.size + length > size:
            break
        at += MESSAGE_HEAD.size + length
    return at
