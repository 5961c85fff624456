"""The directory that a command leaves its results in."""

from __future__ import annotations

from pathlib import Path

from rtcore.config import ConfigError


def make_out_dir(out: Path) -> list[Path]:
    """Make `out`, which must not exist yet; returns what was made, the deepest first.

    Raises:
        ConfigError: it is there already, or cannot be made.
    """
    made = [path for path in (out, *out.parents) if not path.exists()]
    try:
        out.mkdir(parents=True)
    except FileExistsError as error:
        raise ConfigError("out", str(out), "must not exist yet") from error
    except OSError as error:
        raise ConfigError("out", str(out), f"must be a path to write to ({error.strerror})") from error
    return made
