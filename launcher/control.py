"""`tenuto status|hold|resume|schedule|stop`: orders to a system that runs."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.text import Text

from launcher import drawing
from launcher.cli import DONE, CommandError
from launcher.parsing import parse
from launcher.run import RUNS
from learner.schedule.timetable import require_constants
from rtcore import cast, channels
from rtcore.bus import Bus, BusError, NoAnswerError
from rtcore.config import ConfigError, ScheduleConfig
from rtcore.config_check import check
from rtcore.messages import Command, CommandReply
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir, latest
from rtcore.zenoh_bus import open_bus
from rtcore.zenoh_config import Endpoints

Verb = Literal["hold", "resume", "status", "stop", "schedule"]


@dataclass(frozen=True)
class ControlOptions:
    """Which run."""

    run_dir: Path | None = None
    """The run directory. None: the newest one in runs/."""


@dataclass(frozen=True, kw_only=True)
class ScheduleOptions(ScheduleConfig):
    """Which run, and the schedule."""

    run_dir: Path | None = None
    """The run directory. None: the newest one in runs/."""


def status(argv: Sequence[str]) -> int:
    """`tenuto status`."""
    run_dir = _run_dir(argv, "status", "What each process of a run is doing.")
    rows: list[tuple[str, Text | str]] = []
    answered = 0
    with _joined(run_dir) as bus:
        for process in cast.names(run_dir.config()):
            try:
                reply = _ask(bus, process, "status")
            except NoAnswerError:
                rows.append((process, Text("does not answer", style="yellow")))
            else:
                answered += 1
                rows.append((process, reply.text))
    if not answered:
        raise _silence(run_dir)
    console = Console()
    console.print(f"run  {run_dir.path}", highlight=False, soft_wrap=True)
    console.print(drawing.pairs(rows))
    return DONE


def hold(argv: Sequence[str]) -> int:
    """`tenuto hold`."""
    run_dir = _run_dir(argv, "hold", "Hold the policy until `tenuto resume`; the critics go on.")
    return _order(run_dir, "hold", channels.LEARNER)


def resume(argv: Sequence[str]) -> int:
    """`tenuto resume`."""
    run_dir = _run_dir(argv, "resume", "Go on with the schedule after `tenuto hold`.")
    return _order(run_dir, "resume", channels.LEARNER)


def schedule(argv: Sequence[str]) -> int:
    """`tenuto schedule KIND`."""
    argv = ["--kind", *argv] if argv and not argv[0].startswith("-") else argv
    description = (
        "Go by another schedule (KIND, first, or --kind) once the present window has ended; what is not "
        "given stays as the run has it."
    )
    run_dir = _found(parse(ScheduleOptions, argv, prog="tenuto schedule", description=description).run_dir)
    config = run_dir.config()
    base = config.learner.schedule
    shared = {one.name: getattr(base, one.name) for one in fields(ScheduleConfig)}
    default = ScheduleOptions(run_dir=run_dir.path, **shared)
    options = parse(ScheduleOptions, argv, prog="tenuto schedule", description=description, default=default)
    wanted = ScheduleConfig(**{name: getattr(options, name) for name in shared})
    check(replace(config, learner=replace(config.learner, schedule=wanted)))  # wrong even if nothing runs
    require_constants(wanted)
    return _order(run_dir, "schedule", channels.LEARNER, wanted)


def stop(argv: Sequence[str]) -> int:
    """`tenuto stop`."""
    description = (
        "End the environment server, of a fleet all, in order; `tenuto run` then ends all the others."
    )
    return _order(_run_dir(argv, "stop", description), "stop", channels.ENV_SERVER)


def _order(run_dir: RunDir, verb: Verb, role: str, wanted: ScheduleConfig | None = None) -> int:
    """Give an order to all processes of a role. One that does not answer keeps no other from its own; nor is
    it a failure, if it is not there and another one is.
    """
    failures: list[CommandError] = []
    absent: list[str] = []
    processes = cast.of_role(run_dir.config(), role)
    with _joined(run_dir) as bus:
        for process in processes:
            try:
                reply = _ask(bus, process, verb, wanted)
            except NoAnswerError:
                if process in bus.alive():
                    failures.append(_silence(run_dir, process))
                else:
                    absent.append(process)
                continue
            if reply.ok:
                _say(f"{process}: {reply.text}")
            else:
                failures.append(CommandError(f"{process}: {reply.text}"))
    if len(absent) == len(processes):
        failures = [_silence(run_dir, process) for process in absent]
        absent = []
    for process in absent:
        _say(f"{process}: is not there: it has ended, or is between two lives; then {verb} again")
    if failures:
        raise CommandError("; ".join(map(str, failures)))
    return DONE


def _run_dir(argv: Sequence[str], command: str, description: str) -> RunDir:
    options = parse(ControlOptions, argv, prog=f"tenuto {command}", description=description)
    return _found(options.run_dir)


def _found(path: Path | None) -> RunDir:
    if path is not None:
        return RunDir.open(path)
    newest = latest(RUNS)
    if newest is None:
        raise ConfigError("run_dir", None, f"must be given: there is no run in {RUNS}/")
    return newest


@contextmanager
def _joined(run_dir: RunDir) -> Iterator[Bus]:
    config = run_dir.config()
    link = config.link
    try:
        with open_bus(
            "client",
            run_dir.run_name,
            run_dir.socket_dir(),
            clock=MonotonicClock(),
            peers=cast.names(config),
            endpoints=Endpoints(connect=link.connect),
            secure=link.secure,
        ) as bus:
            yield bus
    except BusError as error:
        raise CommandError(str(error)) from error


def _ask(bus: Bus, process: str, verb: Verb, wanted: ScheduleConfig | None = None) -> CommandReply:
    return bus.ask(process, Command(id=uuid.uuid4().hex, verb=verb, schedule=wanted), timeout_s=1.0, tries=3)


def _say(text: str) -> None:
    Console().print(text, highlight=False, soft_wrap=True)


def _silence(run_dir: RunDir, process: str = "") -> CommandError:
    who = f"{process} does not answer" if process else "nothing answers"
    return CommandError(f"{who} in {run_dir.path}: is the run still going?")
