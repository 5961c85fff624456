"""The command line of this process as the system shows it to others (`ps`, /proc/PID/cmdline): Linux only."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path

_STAT = Path("/proc/self/stat")
_START, _END = 45, 46  # arg_start and arg_end among the fields behind the name; see proc_pid_stat(5)


def room() -> tuple[int, int]:
    """Where this process's command line is in its memory, and for how many bytes there is room.

    Raises:
        OSError: the system does not say where it is.
    """
    fields = _STAT.read_text().rpartition(")")[2].split()
    start, end = int(fields[_START]), int(fields[_END])
    if not 0 < start < end:
        raise OSError("the system does not say where the command line is")
    return start, end - start


def replace(command: Sequence[str]) -> None:
    """Show another command line from now on. It takes the room of the one that the process was started with,
    which must be as long; `sys.argv` stays what it was.

    Raises:
        OSError: the system does not say where it is, or it has no room for this one.
    """
    start, size = room()
    text = b"".join(os.fsencode(word) + b"\0" for word in command)
    if len(text) > size:
        raise OSError(f"a command line of {len(text)} bytes has no room in {size}")
    ctypes.memmove(start, text.ljust(size, b"\0"), size)
