"""Command lines by tyro, with every mistake as one line: the field, its value, what is allowed."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import NoReturn, TypeVar

import tyro

# tyro reports its failures as a box for people and, to a hook, as structured events. The hook is not
# part of its stable interface, so pyproject.toml pins tyro; an event unknown here is cut out of the box.
from tyro import _errors

from rtcore.config import ConfigError

OptionsT = TypeVar("OptionsT")

_WORDS = {"INT": "a whole number", "FLOAT": "a number", "STR": "text", "PATH": "a path"}
HELP_FLAGS = ("-h", "--help")


def parse(
    options: type[OptionsT],
    argv: Sequence[str],
    *,
    prog: str,
    description: str,
    default: OptionsT | None = None,
) -> OptionsT:
    """Parse `argv` into `options`; `default` gives the values of what is left out.

    Raises:
        ConfigError: the command line is wrong.
        SystemExit: help was asked for and printed.
    """

    def refuse(event: _errors.ParseErrorEvent) -> None:
        raise _as_config_error(event, argv)

    stderr = io.StringIO()
    try:
        with _errors.on_parse_error(refuse), contextlib.redirect_stderr(stderr):
            return tyro.cli(
                options,
                prog=prog,
                description=description,
                args=list(argv),
                default=tyro.MISSING_NONPROP if default is None else default,
            )
    except SystemExit as exit_:
        if exit_.code in (0, None):
            raise
        _refuse_boxed(stderr.getvalue())


def value_after(flag: str, argv: Sequence[str]) -> str | None:
    """What follows `flag` on the command line (`--flag value` or `--flag=value`); None if nothing does."""
    for index, token in enumerate(argv):
        if token.startswith(flag + "="):
            return token.removeprefix(flag + "=")
        if token == flag:
            rest = argv[index + 1 :]
            return rest[0] if rest else None
    return None


def given(flag: str, argv: Sequence[str]) -> bool:
    """Whether the command line sets `flag`."""
    return any(token == flag or token.startswith(flag + "=") for token in argv)


def _as_config_error(event: _errors.ParseErrorEvent, argv: Sequence[str]) -> ConfigError:
    if isinstance(event, _errors.UnrecognizedArgs):
        return ConfigError("argument", event.tokens[0], "not known here; --help lists what is")
    if isinstance(event, _errors.InvalidChoice):
        return ConfigError(_field(event.argument), event.value, "one of " + ", ".join(event.choices))
    if isinstance(event, _errors.BadValue):
        return ConfigError(
            _field(event.argument), event.offending_value or "", f"must be {_kind(event.argument)}"
        )
    if isinstance(event, _errors.InstantiationFailure) and event.argument is not None:
        flag = event.argument.lowered.name_or_flags[-1] if event.argument.lowered.name_or_flags else ""
        value = value_after(flag, argv) if flag else None
        return ConfigError(_field(event.argument), value, f"must be {_kind(event.argument)}")
    if isinstance(event, _errors.MissingArgs):
        return ConfigError(_field(event.missing_arguments[0].arg), "", "must be given")
    return ConfigError("arguments", " ".join(argv), "not understood; --help shows how")


def _field(argument: object) -> str:
    """`--env.on-miss` is the field `env.on_miss`."""
    name = str(argument.display_name())  # type: ignore[attr-defined]
    return name.lstrip("-").replace("-", "_")


def _kind(argument: object) -> str:
    """What the help calls `{None}|FLOAT` or `[INT [INT ...]]`, in words."""
    metavar = str(argument.lowered.metavar)  # type: ignore[attr-defined]
    if metavar.startswith("["):
        return f"{_WORDS.get(metavar.strip('[').split(' ')[0].rstrip(']'), metavar)}, any number of times"
    parts = [_WORDS.get(part, part.strip("{}").replace(",", ", ")) for part in metavar.split("|")]
    return " or ".join(sorted(parts, key=lambda part: part == "None"))


def _refuse_boxed(text: str) -> NoReturn:
    """What is left: the words of the box, without its frame, on one line."""
    words = re.sub(r"[\u2500-\u257f]|\s+", " ", re.sub(r"\x1b\[[0-9;]*m", "", text))
    raise ConfigError("arguments", "", re.sub(r" +", " ", words).strip())
