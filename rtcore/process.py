"""What the four processes have in common: arguments, placement, bus, ledger, signals, and the end.

    sys.exit(run_process(channels.AGENT, serve))

Whatever happens in `serve`, the process's final stats are published and written.
"""

from __future__ import annotations

import argparse
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rtcore import cast, channels, realtime, signing
from rtcore.bus import Bus, BusError
from rtcore.cast import Part
from rtcore.clock import Clock
from rtcore.config import ConfigError, RunConfig
from rtcore.crew import Crew
from rtcore.ledger import Ledger, brief
from rtcore.lifecycle import Continuations, Stop, die_with_parent, stop_on_signals
from rtcore.log_files import log_to_file
from rtcore.messages import Stats
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.tally import Tally
from rtcore.zenoh_bus import ZenohBus, open_bus, open_bus_by_router
from rtcore.zenoh_config import Endpoints
from rtcore.zenoh_refusals import LOG_FILTER
from rtcore.zenoh_session import leave
from rtcore.zenoh_watch import watched

REPORT_PERIOD_S = 0.25  # the rate in the channel table
JOIN_LIMIT_S = 2.0  # a thread blocked in a put is left behind, so that a process ends within 5 s
DONE, FAILED, WRONG_INPUT = 0, 1, 2  # exit codes


class Keys(NamedTuple):
    """What policies are signed and checked with: the learner's and the agent's, of any other nothing."""

    signer: signing.Signer
    verifier: signing.Verifier


@dataclass(frozen=True)
class Process:
    """One process's resources, open for as long as the `with` block runs.

    Attributes:
        part: which process of the run it is.
        config: of the run; of a fleet's env server or agent with the name of its own environment.
        incarnation: greater than those of its earlier lives.
    """

    part: Part
    config: RunConfig
    run_dir: RunDir
    clock: Clock
    bus: Bus
    ledger: Ledger
    stop: Stop
    incarnation: int
    continuations: Continuations
    keys: Keys

    @property
    def name(self) -> str:
        """The process's name on the bus and in the run's files."""
        return self.part.name


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
        rejected = self._bus.rejected()
        self._ledger.set_counter("messages.rejected", sum(rejected.values()))
        for channel, count in rejected.items():
            self._ledger.set_counter(f"messages.rejected.{channel}", count)
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
    parser.add_argument(
        "--router",
        default="",
        metavar="EP",
        help="Zenoh router to reach the others through, and nothing else",
    )
    parser.add_argument(
        "--index", type=int, metavar="I", help="env server, agent: which of env.count environments, from 0"
    )
    parser.add_argument("--supervised", type=int, metavar="PID", help="end when this parent process ends")
    return parser.parse_args(argv)


def run_process(role: str, serve: Callable[[Process], None], argv: Sequence[str] | None = None) -> int:
    """Open everything a process needs, serve, and close it in order.

    Returns:
        The exit code: 0 done; 2 what no restart changes, wrong input, or real-time scheduling that is
        required and refused; 1 when the bus cannot be joined. One line on stderr says what is wrong.
    """
    try:
        with open_process(role, argv) as process:
            serve(process)
    except (ConfigError, realtime.RealtimeError) as error:
        sys.stderr.write(f"{role}: {error}\n")
        return leave(WRONG_INPUT)
    except BusError as error:
        sys.stderr.write(f"{role}: {error}\n")
        return leave(FAILED)
    return leave(DONE)


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
    whole = run_dir.config()
    part = cast.part_for(whole, role, arguments.index)
    config, process = cast.as_part(whole, part), part.name
    log_to_file(run_dir.log_path(process), process)
    crew = Crew(part.number, config.env.count, config.env.hz or 0.0)
    placement = realtime.enter(role, config.agent.rt, crew)  # before the bus: its threads inherit it
    clock = MonotonicClock()
    incarnation = run_dir.next_incarnation(process, time.time_ns())
    run = run_dir.run_name
    keys = Keys(signing.open_signer(config.link, role, run), signing.open_verifier(config.link, role, run))
    stop, continuations = Stop(), Continuations(clock.now_ns)
    with (
        _ledger(run_dir, process, incarnation, clock) as ledger,
        stop_on_signals(stop),
        continuations.watched(),
        watched(ledger, clock) if config.link.secure else nullcontext(),
        _open_bus(part, arguments, run_dir, whole, clock) as bus,
    ):
        ledger.event(clock.now_ns(), "INFO", f"{process}: {placement.describe()}")
        reporter = Reporter(ledger, bus, clock, process, continuations)
        try:
            with background(reporter.run, name="reporter", ends=stop):
                yield Process(
                    part, config, run_dir, clock, bus, ledger, stop, incarnation, continuations, keys
                )
        except Exception as error:
            logging.getLogger(process).exception("%s failed", process)
            ledger.event(clock.now_ns(), "ERROR", f"{process} failed: {error}")
            raise
        finally:
            last = reporter.snapshot(final=True)
            _keep(run_dir, last)
            reporter.publish(brief(last))


def _keep(run_dir: RunDir, last: Stats) -> None:
    """Write the last ledger down. On a full disk there is still the tally, and what was said on the bus."""
    try:
        run_dir.write_final_stats(last)
    except OSError as error:
        logging.getLogger(last.process).warning("the last ledger is not on disk: %s", error)


def _open_bus(
    part: Part, arguments: argparse.Namespace, run_dir: RunDir, config: RunConfig, clock: Clock
) -> ZenohBus:
    """The process's connection to the run."""
    link, peers = config.link, cast.names(config)
    if arguments.router:
        if link.secure:
            raise ConfigError(
                "router", arguments.router, "not with link.secure: it would speak for everybody"
            )
        return open_bus_by_router(part.name, run_dir.run_name, arguments.router, clock=clock, peers=peers)
    return open_bus(
        part.name,
        run_dir.run_name,
        run_dir.socket_dir(),
        clock=clock,
        peers=peers,
        endpoints=Endpoints(
            connect=(*link.connect, *arguments.connect), listen=(*link.listen, *arguments.listen)
        ),
        secure=link.secure,
        log_filter=LOG_FILTER if link.secure else "",
    )


@contextmanager
def _ledger(run_dir: RunDir, process: str, incarnation: int, clock: Clock) -> Iterator[Ledger]:
    """The process's ledger with its tally; without one where the disk has no place for it."""
    with ExitStack() as stack:
        try:
            tally = stack.enter_context(Tally.create(run_dir.tally_path(process, incarnation)))
        except OSError as error:
            ledger = Ledger(process, incarnation)
            ledger.count("tally.unbacked")
            ledger.event(
                clock.now_ns(), "WARN", f"{process}: counters die with the process: no tally ({error})"
            )
        else:
            ledger = Ledger(process, incarnation, tally)
        yield ledger


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
