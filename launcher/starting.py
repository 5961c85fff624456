"""The command lines of a run's processes: one source for whoever starts them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from rtcore.cast import index_of, role_of


def process_command(
    process: str,
    run: Path,
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    router: str = "",
    supervisor: int | None = None,
    python: str = sys.executable,
) -> list[str]:
    """The command line of one process.

    Args:
        process: its name, of a fleet like `env_server.2` (`rtcore.cast`).
        run: the run's directory.
        connect: further endpoints to connect to.
        listen: further endpoints to listen on.
        router: endpoint of a Zenoh router to reach the others through, and nothing else.
        supervisor: number of the process with which it ends.
        python: the interpreter.
    """
    found = [python, "-m", role_of(process), "--run", str(run)]
    index = index_of(process)
    found += [] if index is None else ["--index", str(index)]
    for name, endpoints in (("--connect", connect), ("--listen", listen)):
        for endpoint in endpoints:
            found += [name, endpoint]
    found += ["--router", router] if router else []
    return found + (["--supervised", str(supervisor)] if supervisor is not None else [])


def spare_command(command: Sequence[str]) -> list[str]:
    """The command line of a spare, from that of the process it is to become: longer, so that the other one
    finds room in it, and with another module, so that nobody takes it for that process."""
    found = list(command)
    found[found.index("-m") + 1] += ".spare"
    return found
