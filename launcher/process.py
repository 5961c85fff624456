"""`tenuto env|agent|learn|record`: one process of a run, here or with endpoints to other machines.

Any of them may be first: it makes the run directory, the later ones use it.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from launcher import options
from launcher.starting import process_command
from rtcore import cast, channels
from rtcore.config import ConfigError, RunConfig
from rtcore.run_dir import RunDir

CREATION_WAIT_S = 2.0  # another process makes the directory at this moment: it takes milliseconds


def env(argv: Sequence[str]) -> int:
    """`tenuto env`."""
    _become(channels.ENV_SERVER, "env", "The environment server alone.", argv)


def agent(argv: Sequence[str]) -> int:
    """`tenuto agent`."""
    _become(channels.AGENT, "agent", "The agent alone.", argv)


def learn(argv: Sequence[str]) -> int:
    """`tenuto learn`."""
    _become(channels.LEARNER, "learn", "The learner alone.", argv)


def record(argv: Sequence[str]) -> int:
    """`tenuto record`."""
    _become(channels.RECORDER, "record", "The recorder alone.", argv)


def _become(role: str, command: str, does: str, argv: Sequence[str]) -> NoReturn:
    """Replace this process by the one that was asked for, so that signals reach it directly."""
    description = options.describe(f"{does} An existing run directory already says which run it is.")
    config, chosen = options.read(
        options.ProcessOptions, argv, prog=f"tenuto {command}", description=description
    )
    if chosen.run_dir is None:
        raise ConfigError("run_dir", None, "must be given: the directory that the run's processes share")
    part = cast.part_for(config, role, chosen.index)
    options.require_keys(config.link, [role], (*chosen.connect, *chosen.listen))
    run_dir = _join(chosen.run_dir, config)
    arguments = process_command(
        part.name, run_dir.path, connect=chosen.connect, listen=chosen.listen, router=chosen.router
    )
    sys.stdout.flush()
    os.execv(sys.executable, arguments)


def _join(path: Path, config: RunConfig) -> RunDir:
    """The run directory: made if it is not there, else with the same settings in it."""
    if not path.exists():
        try:
            return RunDir.create(path, config)
        except ConfigError:
            if not path.exists():  # not somebody who was faster
                raise
    deadline = time.monotonic() + CREATION_WAIT_S
    while not RunDir(path).config_path.is_file() and time.monotonic() < deadline:
        time.sleep(0.01)
    run_dir = RunDir.open(path)
    if run_dir.config() != config:
        allowed = "has a run.toml with other settings; give none here, or name a new directory"
        raise ConfigError("run_dir", str(path), allowed)
    return run_dir
