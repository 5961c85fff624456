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

from launcher import options, regret, report
from launcher.cli import DONE, FAILED, INTERRUPTED, CommandError
from launcher.herald import logged
from launcher.lookout import Lookout
from launcher.mending import mend
from launcher.restarts import Happening, Restarts
from launcher.screen import Screen
from launcher.summary import Summary, passed, summarise
from launcher.supervisor import End, Interrupts, Supervisor, command_for
from launcher.viewer import Viewer
from launcher.vitals import Vitals
from launcher.watch import Watch
from rtcore import cast, channels, epoch, realtime
from rtcore.bus import BusError
from rtcore.cast import role_of
from rtcore.config import ConfigError, RunConfig
from rtcore.files import write_atomic
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir, default_run_path
from rtcore.signing import OPERATOR
from rtcore.zenoh_bus import open_bus

RUNS = Path("runs")
NICENESS = 5  # drawing a screen is never worth a missed deadline


def run(argv: Sequence[str]) -> int:
    """`tenuto run [PRESET] ...`."""
    description = options.describe("Learn in real time, with all processes on this machine.")
    config, chosen = options.read(options.RunOptions, argv, prog="tenuto run", description=description)
    options.require_keys(config.link, (*dict.fromkeys(map(role_of, _wanted(config))), OPERATOR))
    run_dir = RunDir.create(chosen.run_dir or default_path(config), config)
    clock, console = MonotonicClock(), Console()
    console.print(f"run  {run_dir.path}", highlight=False, soft_wrap=True)
    watch = Watch(config.env.hz or 1.0)
    screen = Screen(console, config, run_dir.run_name, watch, clock)
    began_ns = clock.now_ns()
    try:
        end = _carry_out(config, run_dir, watch, screen, clock)
    except (BusError, OSError) as error:
        run_dir.remove_if_empty()
        raise CommandError(str(error)) from error
    wall_s = (clock.now_ns() - began_ns) / 1e9
    run_dir.remove_socket_dir()
    if end.reason == "killed":
        sys.stderr.write(f"tenuto: killed; what lies in {run_dir.path} may be incomplete\n")
        return INTERRUPTED
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
    summary |= regret.of_run(config, run_dir)
    kept = _keep(summary, run_dir)
    console.print(report.render(summary, run_dir))
    _complain(end, run_dir)
    return DONE if kept and not end.failures and not end.forced else FAILED


def default_path(config: RunConfig) -> Path:
    """Where a run goes that names no directory."""
    return default_run_path(RUNS, config.preset, datetime.now(UTC))


def write_summary(run_dir: RunDir, summary: Summary) -> None:
    """Write summary.json whole."""
    write_atomic(run_dir.summary_path, (json.dumps(summary, indent=2) + "\n").encode())


def _keep(summary: Summary, run_dir: RunDir) -> bool:
    """Write summary.json, or say why not: the report is printed all the same."""
    try:
        write_summary(run_dir, summary)
    except OSError as error:
        sys.stderr.write(f"tenuto: {run_dir.summary_path} is not written: {error.strerror or error}\n")
        return False
    return True


def _wanted(config: RunConfig) -> tuple[str, ...]:
    """The run's processes."""
    return cast.names(config, record=config.recorder.record)


def _carry_out(
    config: RunConfig, run_dir: RunDir, watch: Watch, screen: Screen, clock: MonotonicClock
) -> End:
    """Start the processes, watch over them, end them."""
    interrupts, wanted = Interrupts(), _wanted(config)
    viewer = Viewer(config.recorder, run_dir.logs_dir / "viewer.out")
    lookout = Lookout(watch, Vitals(config.supervise.stuck_s), screen, viewer, clock)
    supervisor = Supervisor(
        {name: command_for(name, run_dir.path) for name in wanted},
        run_dir.logs_dir,
        restarts=Restarts(config.supervise),
        vitals=lookout.vitals,
        tell=lookout.happened,
    )
    with interrupts.counted():
        with supervisor.started():
            os.nice(NICENESS)
            with (
                realtime.out_of_the_way(config.agent.rt),
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
        unfinished = channels.RECORDER in wanted and not supervisor.ended_well(channels.RECORDER)
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
    whole = int(config.duration_s * (config.env.hz or 1.0))
    servers = cast.of_role(config, channels.ENV_SERVER)
    reached = config.duration_s > 0 and all(passed(watch.totals(name)) >= whole for name in servers)
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
