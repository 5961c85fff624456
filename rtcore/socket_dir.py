"""The directory of a run's unix sockets: private, short enough for the kernel, the same for every process."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from contextlib import suppress
from pathlib import Path

from rtcore.channels import PROCESSES
from rtcore.config import ConfigError

# The kernel takes 107 bytes for a unix socket's path; 100 leaves room for a fleet's, 2 to 3 longer.
SOCKET_PATH_BYTES = 100
# Fixed rather than $TMPDIR: all processes of a run must find the same directory, whoever started them.
TEMP = Path("/tmp")
_SOCKET = re.compile(rf"({'|'.join(PROCESSES)})(\.\d+)?\.sock(\.lock)?")  # of a fleet with a number
PORTS = "ports.json"  # of `rtcore.zenoh_ports`


def make(run: Path) -> Path:
    """The directory of the unix sockets (`<process>.sock`) of the run in `run`, made if need be: private to
    this user, the same for every process of the run, short enough for the kernel and free of what means
    something in an endpoint. It is `link` in the run if that will do, else one below /tmp.

    Raises:
        ConfigError: it cannot be made, or others could reach into it.
    """
    directory = path_for(run)
    try:
        with suppress(FileExistsError):
            directory.mkdir(mode=0o700)
        found = directory.lstat()
    except OSError as error:
        allowed = f"must be a directory that can be made ({error.strerror})"
        raise ConfigError("run_dir.socket_dir", str(directory), allowed) from error
    mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid()
    if not mine or stat.S_IMODE(found.st_mode) & 0o077:
        allowed = f"must be a directory of user {os.geteuid()} with mode 0700"
        raise ConfigError("run_dir.socket_dir", str(directory), allowed)
    return directory


def remove(run: Path) -> None:
    """Remove the directory with the stale sockets and locks in it, once every process of the run has ended.
    What else lies there stays, and so does the directory then."""
    directory = path_for(run)
    if not directory.is_dir() or directory.is_symlink() or directory.stat().st_uid != os.geteuid():
        return
    (directory / PORTS).unlink(missing_ok=True)
    for path in directory.iterdir():
        if _SOCKET.fullmatch(path.name):
            path.unlink(missing_ok=True)
    with suppress(OSError):
        directory.rmdir()


def path_for(run: Path) -> Path:
    """Where it is, or would be."""
    # Resolved: processes that were given the run by different paths must come to the same answer.
    home = run.resolve()
    near = home / "link"
    longest = max(len(os.fsencode(near / f"{process}.sock")) for process in PROCESSES)
    if longest <= SOCKET_PATH_BYTES and re.fullmatch(r"[A-Za-z0-9_./+-]+", str(near)):
        return near
    digest = hashlib.sha256(os.fsencode(home)).hexdigest()[:16]
    return TEMP / f"tenuto-{os.geteuid()}-{digest}"
