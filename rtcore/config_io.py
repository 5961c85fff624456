"""A run's configuration as TOML: strict on the way in, whole on the way out."""

from __future__ import annotations

import dataclasses
import tomllib
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
import tomli_w

from rtcore.config import ConfigError, RunConfig

SectionT = TypeVar("SectionT")

_WORDS = {int: "an integer", float: "a number", str: "a string", bool: "true or false"}


def load_toml(path: Path) -> RunConfig:
    """Read a configuration; what the file leaves out has its default. Ranges are `config_check`'s.

    Raises:
        ConfigError: the file cannot be read, is no TOML, or has an unknown key or a wrong type.
    """
    try:
        with path.open("rb") as file:
            table = tomllib.load(file)
    except OSError as error:
        raise ConfigError("config", str(path), f"must be a readable file ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError("config", str(path), f"must be valid TOML ({error})") from error
    return from_table(table)


def from_table(table: Mapping[str, object]) -> RunConfig:
    """A configuration from nested tables of plain values, as TOML has them.

    Raises:
        ConfigError: an unknown key or a wrong type.
    """
    return _section(RunConfig, table, "")


def dump_toml(config: RunConfig) -> str:
    """The configuration as TOML; `load_toml` gives an equal one back. TOML has no null: a field that is
    None is left out."""
    return tomli_w.dumps(_without_none(dataclasses.asdict(config)))


def _section(kind: type[SectionT], table: Mapping[str, object], prefix: str) -> SectionT:
    hints = get_type_hints(kind)
    values: dict[str, object] = {}
    for key, value in table.items():
        name = f"{prefix}{repr(key)[1:-1]}"  # a quoted key may hold anything, a line break too
        if key not in hints:
            raise ConfigError(name, value, f"unknown key; allowed here: {', '.join(hints)}")
        hint = hints[key]
        if not (isinstance(hint, type) and dataclasses.is_dataclass(hint)):
            values[key] = _leaf(hint, value, name)
        elif isinstance(value, Mapping):
            values[key] = _section(hint, value, f"{name}.")
        else:
            raise ConfigError(name, value, "must be a table")
    return kind(**values)


def _leaf(hint: object, value: object, name: str) -> object:
    try:
        return msgspec.convert(value, type=hint)
    except msgspec.ValidationError as error:
        raise ConfigError(name, value, f"must be {_describe(hint)}") from error


def _describe(hint: object) -> str:
    """What a type allows, in words: `float | Literal["auto"]` is "a number or 'auto'"."""
    if hint in _WORDS:
        return _WORDS[hint]
    arguments = get_args(hint)
    origin = get_origin(hint)
    if origin is Literal:
        choices = ", ".join(map(repr, arguments))
        return choices if len(arguments) == 1 else f"one of {choices}"
    if origin in (Union, types.UnionType):
        return " or ".join(_describe(kind) for kind in arguments if kind is not types.NoneType)
    if origin is tuple:
        return f"an array, each entry {_describe(arguments[0])}"
    raise TypeError(f"{hint}: a configuration field of a type that TOML cannot hold")


def _without_none(table: dict[str, object]) -> dict[str, object]:
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in table.items()
        if value is not None
    }
