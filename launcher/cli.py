"""The `tenuto` command: a table of commands, and what becomes of their mistakes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import cast

from rich.console import Console
from rich.table import Table

from launcher.parsing import HELP_FLAGS
from rtcore.config import ConfigError

DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130

Main = Callable[[Sequence[str]], int]


class CommandError(Exception):
    """The command could not do what it was asked to, for a reason that fits on one line."""


@dataclass(frozen=True, slots=True)
class Command:
    """One row: what the user types, the function that does it (`module:function`), and a line of help."""

    name: str
    function: str
    help: str

    def load(self) -> Main:
        """Import the function; only now, so that no command pays for the libraries of another."""
        module, function = self.function.split(":")
        return cast(Main, getattr(import_module(module), function))


COMMANDS = (
    Command("run", "launcher.run:run", "all processes on this machine, until the duration or Ctrl-C"),
    Command("sim", "launcher.run_sim:run_sim", "the same in virtual time: deterministic, as fast as can be"),
    Command("env", "launcher.process:env", "the environment server alone"),
    Command("agent", "launcher.process:agent", "the agent alone"),
    Command("learn", "launcher.process:learn", "the learner alone"),
    Command("record", "launcher.process:record", "the recorder alone"),
    Command("status", "launcher.control:status", "what each process of a run is doing"),
    Command("health", "launcher.health:health", "whether one process's loop turns, as an exit code"),
    Command("hold", "launcher.control:hold", "hold the policy of a running system"),
    Command("resume", "launcher.control:resume", "go on with the schedule after a hold"),
    Command("schedule", "launcher.control:schedule", "change the schedule of a running learner"),
    Command("stop", "launcher.control:stop", "end a running system in order"),
    Command(
        "latency",
        "launcher.latency.command:latency",
        "the real-time test of this machine, beside a bare echo",
    ),
    Command(
        "doctor",
        "launcher.doctor.command:doctor",
        "what this machine lacks for real time, and how to grant it",
    ),
    Command(
        "plan",
        "launcher.plan.command:plan",
        "how long to update and to hold, by the paper's bound",
    ),
    Command(
        "chaos",
        "launcher.chaos.command:chaos",
        "a run whose processes are killed and stopped at random, and whether it kept its promises",
    ),
    Command("report", "launcher.report:report", "a run's report again"),
    Command("view", "launcher.view:view", "open a run's recording in Rerun"),
    Command("router", "launcher.router:router", "a Zenoh router, for processes on other machines"),
    Command("compose", "launcher.deploy:compose", "the compose.yaml of a run in containers"),
    Command("keys", "launcher.keys:keys", "make the certificates and keys for --link.secure"),
)


def run_command(argv: Sequence[str]) -> int:
    """Run one command.

    Returns:
        The exit code: 0 done, 2 wrong input, 1 anything else, 130 interrupted.
    """
    try:
        if not argv or argv[0] in HELP_FLAGS:
            _show_commands(Console())
            return DONE
        return _find(argv[0]).load()(argv[1:])
    except ConfigError as error:
        _complain(error)
        return WRONG_INPUT
    except CommandError as error:
        _complain(error)
        return FAILED
    except KeyboardInterrupt:
        return INTERRUPTED


def _find(name: str) -> Command:
    for command in COMMANDS:
        if command.name == name:
            return command
    raise ConfigError("command", name, "one of " + ", ".join(command.name for command in COMMANDS))


def _complain(error: Exception) -> None:
    """Say what is wrong, on one line."""
    sys.stderr.write("tenuto: " + " ".join(str(error).split()) + "\n")


def _show_commands(console: Console) -> None:
    table = Table.grid(padding=(0, 3))
    for command in COMMANDS:
        table.add_row(f"  [bold]{command.name}", command.help)
    console.print("usage: tenuto COMMAND ...   (tenuto COMMAND --help says what it takes)\n")
    console.print(table)
