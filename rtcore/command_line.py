"""The command line of this process as the system shows it to others (`ps`, /proc/PID/cmdline): Linux only."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path

_STAT = Path("/proc/self/stat")
_START, _END = 45, 46  # arg_start and arg_end among the fields behind the name; see proc_pid_stat(5)


def replace(command: Sequence[str]) -> None:
    """Show another command line from now on. It takes the room of the one that the process was started with,
    which must be as long; `sys.argv` stays what it was.

    Raises:
        OSError: the system does not say where it is, or it has no room for this one.
    """
    fields = _STAT.read_text().rpartition(")")[2].split()
    start, room = int(fields[_START]), int(fields[_END]) - int(fields[_START])
    text = b"".join(word.encode() + b"\0" for word in command)
    if len(text) > room:
        raise OSError(f"a command line of {len(text)} bytes has no room in {room}")
    ctypes.memmove(start, text.ljust(room, b"\0"), room)
