"""`tenuto view RUN`: open a run's recording in the Rerun viewer."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from tyro.conf import Positional

from launcher.parsing import parse
from rtcore.config import ConfigError
from rtcore.run_dir import RunDir


@dataclass(frozen=True)
class ViewOptions:
    """Open a run's recording."""

    run: Positional[Path]
    """The run directory."""
    web: bool = False
    """In the browser, served on this machine alone, instead of a window."""


def view(argv: Sequence[str]) -> NoReturn:
    """`tenuto view RUN`."""
    options = parse(ViewOptions, argv, prog="tenuto view", description="Open a run's recording in Rerun.")
    recording = RunDir(options.run).recording_path
    if not recording.is_file():
        raise ConfigError("run", str(options.run), "needs a recording.rrd in it")
    # The viewer is a program of its own; the recorder alone imports its library.
    arguments = [sys.executable, "-m", "rerun", str(recording)]
    if options.web:
        arguments += ["--web-viewer", "--bind", "127.0.0.1"]
    os.execv(sys.executable, arguments)
