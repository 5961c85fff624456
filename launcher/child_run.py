"""`tenuto run` as a child, for who does something to it or watches it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from rtcore.config import RunConfig
from rtcore.config_io import dump_toml


@contextmanager
def started(
    config: RunConfig, path: Path, *, output: IO[bytes] | None = None, cwd: Path | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """A run of that configuration; whatever becomes of us, it does not go on.

    Args:
        config: of the run.
        path: its directory, to be made by it.
        output: what it prints goes there; None: where ours goes.
        cwd: where it is started; None: here.
    """
    with tempfile.NamedTemporaryFile(suffix=".toml") as file:
        file.write(dump_toml(config).encode())
        file.flush()
        command = [sys.executable, "-m", "launcher", "run", "--config", file.name, "--run-dir", str(path)]
        errors = None if output is None else subprocess.STDOUT
        # In a process group of its own: a Ctrl-C is ours, and whether it is passed on is the caller's choice.
        child = subprocess.Popen(
            command, cwd=cwd, process_group=0, stdin=subprocess.DEVNULL, stdout=output, stderr=errors
        )
        try:
            yield child
        finally:
            if child.poll() is None:
                child.kill()  # its processes end when it does
                child.wait()
