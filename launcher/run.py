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

from launcher import options, report
from launcher.cli import DONE, FAILED, INTERRUPTED, CommandError
from launcher.screen import Screen
from launcher.summary import Summary, summarise
from launcher.supervisor import End, Interrupts, Supervisor, command_for
from launcher.viewer import Viewer
from launcher.watch import Watch
from rtcore import channels, realtime
from rtcore.bus import Bus, BusError
from rtcore.config import RunConfig
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir, default_run_path, write_atomic
from rtcore.zenoh_bus import open_bus

RUNS = Path("runs")
NICENESS = 5  # drawing a screen is never worth a missed deadline


def run(argv: Sequence[str]) -> int:
    """`tenuto run [PRESET] ...`."""
    description = options.describe("Learn in real time, with all processes on this machine.")
    config, chosen = options.read(options.RunOptions, argv, prog="tenuto run", description=description)
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
        restarts={},
        ended=_why(end, config, watch),
        forced=end.forced,
    )
    write_summary(run_dir, summary)
    console.print(report.render(summary, run_dir))
    _complain(end, run_dir)
    return FAILED if end.failures or end.forced else DONE


def default_path(config: RunConfig) -> Path:
    """Where a run goes that names no directory."""
    return default_run_path(RUNS, config.preset, datetime.now(UTC))


def write_summary(run_dir: RunDir, summary: Summary) -> None:
    """Write summary.json whole."""
    write_atomic(run_dir.summary_path, (json.dumps(summary, indent=2) + "\n").encode())


def _carry_out(
    config: RunConfig, run_dir: RunDir, watch: Watch, screen: Screen, clock: MonotonicClock
) -> End:
    """Start the processes, watch them, end them."""
    wanted = [name for name in channels.PROCESSES if name != channels.RECORDER or config.recorder.record]
    supervisor = Supervisor({name: command_for(name, run_dir.path) for name in wanted}, run_dir.logs_dir)
    interrupts = Interrupts()
    viewer = Viewer(config.recorder, run_dir.logs_dir / "viewer.out")
    with interrupts.counted(), supervisor.started():
        os.nice(NICENESS)
        with (
            realtime.out_of_the_way(config.agent.rt),
            open_bus("client", run_dir.run_name, run_dir.socket_dir(), clock=clock) as bus,
            closing(viewer),
            screen.shown(),
        ):
            return _watch_over(supervisor, interrupts, bus, watch, screen, viewer)


def _watch_over(
    supervisor: Supervisor, interrupts: Interrupts, bus: Bus, watch: Watch, screen: Screen, viewer: Viewer
) -> End:
    ledgers = bus.queue(channels.STATS, "*")

    def poll(waiting_for: frozenset[str]) -> None:
        for received in ledgers.drain():
            watch.feed(received.message, received.received_ns)
        if viewer.due and watch.heard(channels.RECORDER):
            viewer.open()
            screen.say(f"view {viewer.address}")
        if waiting_for:
            screen.note = "ending: " + ", ".join(name for name in channels.PROCESSES if name in waiting_for)
        screen.update()

    end = supervisor.supervise(interrupts, poll)
    poll(frozenset())  # the last messages
    return end


def _why(end: End, config: RunConfig, watch: Watch) -> str:
    """Why the run ended, in a few words."""
    if end.failures:
        return "; ".join(str(failure) for failure in end.failures)
    if end.reason == "interrupted":
        return "interrupted"
    env = watch.totals(channels.ENV_SERVER).counters
    whole = config.duration_s * (config.env.hz or 1.0)
    reached = config.duration_s > 0 and env["ticks"] + env["skipped"] >= int(whole)
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
