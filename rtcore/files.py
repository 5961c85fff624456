"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_SUFFIX = ".tmp"  # of a file that is not whole yet


def write_atomic(path: Path, data: bytes, *, synced: bool = True) -> None:
    """Write a file so that, whatever happens, there is the old one or the new one, whole and on the disk.

    Args:
        path: of the file.
        data: all of it.
        synced: whether to wait for the disk, some ms; if not, only a process's end is survived until `sync`.

    Raises:
        OSError: it could not be written; the old one is untouched.
    """
    with _written_aside(path, data, synced=synced) as temporary:
        temporary.replace(path)
    if synced:
        _keep_names(path.parent)


def sync(path: Path) -> None:
    """Wait until the disk has a file, and its name.

    Raises:
        OSError: it could not be written.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    _keep_names(path.parent)


def write_once(path: Path, data: bytes) -> None:
    """Like `write_atomic`, for a file that must not be there yet: of several writers one succeeds.

    Raises:
        FileExistsError: it is there.
        OSError: it could not be written.
    """
    with _written_aside(path, data) as temporary:
        path.hardlink_to(temporary)  # unlike a rename it does not replace
    _keep_names(path.parent)


def sweep(directory: Path) -> None:
    """Remove what writers left that were killed while they wrote. Nobody may be writing there now.

    A directory that is not there, or not writable, stays as it is.
    """
    with suppress(OSError):
        for path in directory.glob(f".*{_SUFFIX}"):
            path.unlink(missing_ok=True)


@contextmanager
def _written_aside(path: Path, data: bytes, *, synced: bool = True) -> Iterator[Path]:
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}{_SUFFIX}")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            if synced:
                os.fsync(file.fileno())
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def _keep_names(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)  # the rename itself
    finally:
        os.close(descriptor)
