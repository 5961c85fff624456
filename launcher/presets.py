"""The presets that are installed, by name.

They stand above the launcher (`experiments`), so they are found by entry point, never imported.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points

from rtcore.config import ConfigError, RunConfig

GROUP = "tenuto.presets"
DEFAULT = "halfcheetah"


def names() -> list[str]:
    """Names of all presets, the default first."""
    return sorted(_entries(), key=lambda name: (name != DEFAULT, name))


def load(name: str) -> RunConfig:
    """The preset's whole configuration, with its name in it.

    Raises:
        ConfigError: there is no such preset.
    """
    entry = _entries().get(name)
    if entry is None:
        raise ConfigError("preset", name, "one of " + (", ".join(names()) or "none: tenuto is not installed"))
    config = entry.load()()
    if not isinstance(config, RunConfig):
        raise TypeError(f"preset {name} returned {type(config).__name__}, not a RunConfig")
    return replace(config, preset=name)


def _entries() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}
