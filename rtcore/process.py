"""What the four processes have in common: arguments, placement, bus, ledger, signals, and the end.

    sys.exit(run_process(channels.AGENT, serve))

Whatever happens in `serve`, the process's final stats are published and written.
"""

from __future__ import annotations

import argparse
import logging
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rtcore import channels, realtime
from rtcore.bus import Bus, BusError
from rtcore.clock import Clock
from rtcore.config import ConfigError, RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Continuations, Stop, die_with_parent, log_to_file, stop_on_signals
from rtcore.messages import Stats
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import open_bus

REPORT_PERIOD_S = 0.25  # the rate in the channel table
JOIN_LIMIT_S = 2.0  # a thread blocked in a put is left behind, so that a process ends within 5 s
DONE, FAILED, WRONG_INPUT = 0, 1, 2  # exit codes


@dataclass(frozen=True)
class Process:
    """One process's resources, open for as long as the `with` block runs."""

    config: RunConfig
    run_dir: RunDir
    clock: Clock
    bus: Bus
    ledger: Ledger
    stop: Stop
    incarnation: int  # its start, monotonic ns
    continuations: Continuations


class Reporter:
    """Publishes a ledger: a few times a second from a thread, and once more at the end."""

    def __init__(
        self,
        ledger: Ledger,
        bus: Bus,
        clock: Clock,
        process: str,
        continuations: Continuations | None = None,
    ) -> None:
        self._ledger = ledger
        self._bus = bus
        self._clock = clock
        self._stats = bus.publisher(channels.STATS, process)
        self._process = process
        self._continuations = continuations

    def snapshot(self, *, final: bool = False) -> Stats:
        """The ledger as it is. A stop and its end are an event in it: no handler may write one."""
        if self._continuations is not None:
            for at_ns in self._continuations.untold_ns():
                self._ledger.event(at_ns, "WARN", f"{self._process}: was stopped, and runs again")
        self._ledger.set_counter("messages.rejected", sum(self._bus.rejected().values()))
        return self._ledger.stats(self._clock.now_ns(), final=final)

    def publish(self, stats: Stats) -> None:
        """Send a snapshot. One that cannot be sent is counted; the next one has everything in it too."""
        try:
            self._stats.put(stats)
        except (ValueError, BusError):
            self._ledger.count("stats.unsent")

    def run(self, stop: Stop) -> None:
        """Publish until stopped."""
        while not stop.wait(REPORT_PERIOD_S):
            self.publish(self.snapshot())


def parse(role: str, argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The arguments that every process takes."""
    parser = argparse.ArgumentParser(prog=f"python -m {role}", description=f"Tenuto's {role}.")
    parser.add_argument(
        "--run", type=Path, required=True, metavar="DIR", help="run directory with a run.toml"
    )
    parser.add_argument(
        "--connect", action="append", default=[], metavar="EP", help="further endpoint to reach"
    )
    parser.add_argument(
        "--listen", action="append", default=[], metavar="EP", help="further endpoint to offer"
    )
    parser.add_argument("--supervised", type=int, metavar="PID", help="end when this parent process ends")
    return parser.parse_args(argv)


def run_process(role: str, serve: Callable[[Process], None], argv: Sequence[str] | None = None) -> int:
    """Open everything a process needs, serve, and close it in order.

    Returns:
        The exit code: 0 done; 2 wrong input, with one line on stderr that says what is wrong; 1 when
        real-time scheduling is required and refused, or the bus cannot be joined.
    """
    try:
        with open_process(role, argv) as process:
            serve(process)
    except ConfigError as error:
        sys.stderr.write(f"{role}: {error}\n")
        return WRONG_INPUT
    except (realtime.RealtimeError, BusError) as error:
        sys.stderr.write(f"{role}: {error}\n")
        return FAILED
    return DONE


@contextmanager
def open_process(role: str, argv: Sequence[str] | None = None) -> Iterator[Process]:
    """Open everything a process needs, and close it in order.

    Raises:
        ConfigError: the run directory or its configuration is wrong.
        RealtimeError: `agent.rt = "require"` and the system refuses.
    """
    arguments = parse(role, argv)
    if arguments.supervised is not None:
        die_with_parent(arguments.supervised)
    run_dir = RunDir.open(arguments.run)
    config = run_dir.config()
    log_to_file(run_dir.log_path(role), role)
    placement = realtime.enter(role, config.agent.rt)  # before the bus: its threads inherit it
    clock = MonotonicClock()
    incarnation = clock.now_ns()
    ledger = Ledger(role, incarnation)
    connect, listen = (*config.link.connect, *arguments.connect), (*config.link.listen, *arguments.listen)
    stop, continuations = Stop(), Continuations(clock.now_ns)
    with (
        stop_on_signals(stop),
        continuations.watched(),
        open_bus(
            role, run_dir.run_name, run_dir.socket_dir(), clock=clock, connect=connect, listen=listen
        ) as bus,
    ):
        ledger.event(incarnation, "INFO", f"{role}: {placement.describe()}")
        process = Process(config, run_dir, clock, bus, ledger, stop, incarnation, continuations)
        reporter = Reporter(ledger, bus, clock, role, continuations)
        try:
            with background(reporter.run, name="reporter", ends=stop):
                yield process
        except Exception as error:
            logging.getLogger(role).exception("%s failed", role)
            ledger.event(clock.now_ns(), "ERROR", f"{role} failed: {error}")
            raise
        finally:
            last = reporter.snapshot(final=True)
            run_dir.write_final_stats(last)
            reporter.publish(last)


@contextmanager
def background(loop: Callable[[Stop], None], *, name: str, ends: Stop) -> Iterator[None]:
    """Run `loop(stop)` on a thread for as long as the block runs, then stop and join it.

    The thread comes after those that act (`realtime.step_back`): it must not delay a tick. If it fails,
    it sets `ends`, the process's own stop, and the block's end raises what it failed with: a process
    never goes on without one of its threads.
    """
    stop = Stop()
    failures: list[Exception] = []

    def run() -> None:
        realtime.step_back()
        try:
            loop(stop)
        except Exception as error:
            logging.getLogger(__name__).exception("thread %s failed", name)
            failures.append(error)
            ends.set(f"thread {name} failed: {error}")

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set(f"{name} ends")
        thread.join(timeout=JOIN_LIMIT_S)
    if failures:
        raise failures[0]
