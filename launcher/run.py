"""`tenuto run`: all processes on this machine, watched until they end, and the report."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from env_server.worlds.period import num_ticks
from launcher import options, regret, report
from launcher.cli import DONE, FAILED, INTERRUPTED, CommandError
from launcher.herald import logged
from launcher.lookout import Lookout
from launcher.mending import mend
from launcher.restarts import Happening, Restarts
from launcher.screen import Screen
from launcher.starting import spare_command
from launcher.streams import dispensable
from launcher.summary import Summary, passed, summarise
from launcher.supervisor import End, Interrupts, Supervisor, command_for
from launcher.viewer import Viewer
from launcher.vitals import Vitals
from launcher.watch import Watch
from rtcore import cast, channels, epoch, realtime
from rtcore.bus import BusError
from rtcore.cast import role_of
from rtcore.config import ConfigError, RunConfig
from rtcore.crew import Crew
from rtcore.files import write_atomic
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir, default_run_path
from rtcore.signing import OPERATOR
from rtcore.zenoh_bus import open_bus

RUNS = Path("runs")
NICENESS = 5  # drawing a screen is never worth a missed deadline
# What a run says whose pairs of env server and agent take every core.
FULL = "{count} environments at {hz:g} Hz have all cores: learner and recorder get what they leave"


def run(argv: Sequence[str]) -> int:
    """`tenuto run [PRESET] ...`."""
    description = options.describe("Learn in real time, with all processes on this machine.")
    config, chosen = options.read(options.RunOptions, argv, prog="tenuto run", description=description)
    options.require_keys(config.link, (*dict.fromkeys(map(role_of, _wanted(config))), OPERATOR))
    run_dir = RunDir.create(chosen.run_dir or default_path(config), config)
    with dispensable():
        return _run(config, run_dir)


def default_path(config: RunConfig) -> Path:
    """Where a run goes that names no directory."""
    return default_run_path(RUNS, config.preset, datetime.now(UTC))


def _run(config: RunConfig, run_dir: RunDir) -> int:
    """From the start of its processes to the report. Until the summary is written, an interrupt counts and
    does no more.
    """
    console, interrupts = Console(), Interrupts()
    console.print(f"run  {run_dir.path}", highlight=False, soft_wrap=True)
    with interrupts.counted():
        end, summary = _lived(config, run_dir, console, interrupts)
        if end.reason == "killed":
            sys.stderr.write(f"tenuto: killed; what lies in {run_dir.path} may be incomplete\n")
            return INTERRUPTED
        kept = keep_summary(summary, run_dir)
    console.print(report.render(summary, run_dir))
    _complain(end, run_dir)
    return DONE if kept and not end.failures and not end.forced else FAILED


def _lived(
    config: RunConfig, run_dir: RunDir, console: Console, interrupts: Interrupts
) -> tuple[End, Summary]:
    """How the run ended, and its summary; an empty one, if it was killed."""
    clock, watch = MonotonicClock(), Watch(config.env.hz or 1.0)
    screen = Screen(console, config, run_dir.run_name, watch, clock)
    began_ns = clock.now_ns()
    try:
        end = _carry_out(config, run_dir, watch, screen, clock, interrupts)
    except (BusError, OSError) as error:
        run_dir.remove_if_empty()
        raise CommandError(str(error)) from error
    wall_s = (clock.now_ns() - began_ns) / 1e9
    run_dir.remove_socket_dir()
    if end.reason == "killed":
        return end, {}
    watch.feed_final(run_dir.read_final_stats())
    summary = summarise(
        config,
        run_dir.run_name,
        watch.stats(),
        wall_s=wall_s,
        restarts=watch.restarts,
        ended=_why(end, config, watch),
        forced=end.forced,
    )
    summary["supervision"] = _told(watch.happenings, run_dir, began_ns)
    impatient = interrupts.count > 1  # it takes a second, and more on a busy machine
    lost = {"regret": None, "regret_missing": "interrupted"} if impatient else regret.of_run(config, run_dir)
    return end, summary | lost


def keep_summary(summary: Summary, run_dir: RunDir) -> bool:
    """Write summary.json whole, or say why not: the report is printed all the same."""
    try:
        write_atomic(run_dir.summary_path, (json.dumps(summary, indent=2) + "\n").encode())
    except OSError as error:
        sys.stderr.write(f"tenuto: {run_dir.summary_path} is not written: {error.strerror or error}\n")
        return False
    return True


def _wanted(config: RunConfig) -> tuple[str, ...]:
    """The run's processes."""
    return cast.names(config, record=config.recorder.record)


def _spares(config: RunConfig, run_dir: RunDir) -> dict[str, list[str]]:
    """Of the agents, in whose absence nobody acts; none where nobody is to be started again."""
    if config.supervise.limit == 0:
        return {}
    last = cast.of_role(config, channels.AGENT)[-1]  # none has a longer command line
    return {channels.AGENT: spare_command(command_for(last, run_dir.path))}


def _supervisor(config: RunConfig, run_dir: RunDir, lookout: Lookout) -> Supervisor:
    """Of the run's processes, told of by `lookout`."""
    return Supervisor(
        {name: command_for(name, run_dir.path) for name in _wanted(config)},
        run_dir.logs_dir,
        spares=_spares(config, run_dir),
        restarts=Restarts(config.supervise),
        vitals=lookout.vitals,
        tell=lookout.happened,
    )


def _carry_out(
    config: RunConfig,
    run_dir: RunDir,
    watch: Watch,
    screen: Screen,
    clock: MonotonicClock,
    interrupts: Interrupts,
) -> End:
    """Start the processes, watch over them, end them."""
    crew = Crew(0, config.env.count, config.env.hz or 0.0)
    viewer = Viewer(config.recorder, run_dir.logs_dir / "viewer.out")
    lookout = Lookout(watch, Vitals(config.supervise.stuck_s), screen, viewer, clock)
    supervisor = _supervisor(config, run_dir, lookout)
    if config.agent.rt != "off" and crew.fills(len(realtime.allowed_cores())):
        screen.say(FULL.format(count=crew.count, hz=crew.hz))
    with supervisor.started():
        os.nice(NICENESS)
        with (
            realtime.out_of_the_way(config.agent.rt, crew),
            logged(run_dir.log_path(channels.LAUNCHER)),
            open_bus(
                "client",
                run_dir.run_name,
                run_dir.socket_dir(),
                clock=clock,
                peers=cast.names(config),
                secure=config.link.secure,
            ) as bus,
            closing(viewer),
            screen.shown(),
        ):
            lookout.join(bus)
            end = supervisor.supervise(interrupts, lookout.look)
            lookout.look(frozenset())  # the last messages
    unfinished = channels.RECORDER in _wanted(config) and not supervisor.ended_well(channels.RECORDER)
    if unfinished and end.reason != "killed":
        mend(run_dir.recording_path, interrupts)
    return end


def _told(happenings: Sequence[Happening], run_dir: RunDir, began_ns: int) -> list[Summary]:
    """Deaths and restarts for the summary, in run time; in seconds since the start if there was no T0."""
    try:
        beginning = epoch.read(run_dir.epoch_path)
    except ConfigError:  # damaged: the env server has said so
        beginning = None
    t0_ns = began_ns if beginning is None else beginning.t0_ns
    return [
        {"at_s": (one.at_ns - t0_ns) / 1e9, "process": one.process, "what": one.what, "code": one.code}
        for one in happenings
    ]


def _why(end: End, config: RunConfig, watch: Watch) -> str:
    """Why the run ended, in a few words."""
    if end.failures:
        return "; ".join(str(failure) for failure in end.failures)
    if end.reason == "interrupted":
        return "interrupted"
    whole = num_ticks(config.env, config.duration_s)
    servers = cast.of_role(config, channels.ENV_SERVER)
    reached = whole > 0 and all(passed(watch.totals(name)) >= whole for name in servers)
    return "duration" if reached else "stopped"


def _complain(end: End, run_dir: RunDir) -> None:
    """Say loudly what went wrong, below the report."""
    for failure in end.failures:
        sys.stderr.write(f"tenuto: {failure}; its last lines:\n")
        sys.stderr.writelines(f"  {line}\n" for line in failure.output.splitlines() or ["(none)"])
    for process in end.forced:
        sys.stderr.write(f"tenuto: {process} did not end in time and was killed\n")
    if end.failures or end.forced:
        sys.stderr.write(f"tenuto: logs are in {run_dir.logs_dir}\n")
