"""`tenuto health`: whether one process's loop turns, as an exit code, for whoever supervises it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from tyro.conf import Positional

from launcher.chaos.faults import Lives
from launcher.cli import DONE, CommandError
from launcher.parsing import parse
from launcher.run_delay import RunDelay
from launcher.vitals import START_NS
from rtcore import cast, channels
from rtcore.bus import Bus, BusError
from rtcore.cast import role_of
from rtcore.clock import Clock
from rtcore.config import ConfigError
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import open_bus
from rtcore.zenoh_config import Endpoints

WAIT_S = 0.25


@dataclass(frozen=True)
class HealthOptions:
    """Which process of which run."""

    process: Positional[str]
    """The process: env_server, agent_service, learner, recorder; of a fleet also like env_server.2."""
    run_dir: Path | None = None
    """The run directory."""
    kill_stuck: bool = False
    """Kill it if it is stuck, so that whoever supervises it starts it again; not in its first 60 s, nor if it
    waited for a core for most of the time."""


def health(argv: Sequence[str]) -> int:
    """`tenuto health PROCESS`."""
    description = "Exit with 0 if a process's own loop turns, with 1 if it does not; on its own machine."
    chosen = parse(HealthOptions, argv, prog="tenuto health", description=description)
    if role_of(chosen.process) not in channels.PROCESSES:
        raise _nobody(chosen.process, channels.PROCESSES)
    if chosen.run_dir is None:
        raise ConfigError("run_dir", None, "must be given")
    run_dir = RunDir.open(chosen.run_dir)
    config, clock = run_dir.config(), MonotonicClock()
    if chosen.process not in cast.names(config):
        raise _nobody(chosen.process, cast.names(config))
    stuck_s = config.supervise.stuck_s
    try:
        with open_bus(
            "client",
            run_dir.run_name,
            run_dir.socket_dir(),
            clock=clock,
            peers=cast.names(config),
            endpoints=Endpoints(connect=config.link.connect),
            secure=config.link.secure,
        ) as bus:
            delays = [RunDelay(pid) for pid in Lives(run_dir.path).pids(chosen.process)]
            waited_s(delays, clock)
            age_s = turned(bus, chosen.process, clock, stuck_s)
    except BusError as error:
        raise CommandError(str(error)) from error
    if age_s is None:
        waiting_s = waited_s(delays, clock)
        starved = waiting_s > stuck_s / 2
        killed = chosen.kill_stuck and not starved and kill(run_dir.path, chosen.process)
        raise CommandError(
            f"{chosen.process} has not turned for {stuck_s:g} s"
            + (f", and waited for a core for {waiting_s:.1f} s" if starved else "")
            + (" and was killed" if killed else "")
        )
    Console().print(f"{chosen.process} turned {age_s:.2f} s ago", highlight=False)
    return DONE


def _nobody(process: str, known: Sequence[str]) -> ConfigError:
    return ConfigError("process", process, "one of " + ", ".join(known))


def waited_s(delays: Sequence[RunDelay], clock: Clock) -> float:
    """For how long a process, which may have gone, waited for a core since the call before."""
    return max((delay.grown_ns(clock.now_ns()) for delay in delays), default=0) / 1e9


def turned(bus: Bus, process: str, clock: Clock, stuck_s: float) -> float | None:
    """How many seconds ago a process's loop turned, by its own word; None: not in the last `stuck_s`, and it
    has been listened to for as long."""
    stats = bus.queue(channels.STATS, process)
    begin_ns = clock.now_ns()
    stuck_ns = round(stuck_s * 1e9)
    while clock.now_ns() - begin_ns < stuck_ns:
        stats.wait(WAIT_S)
        for received in stats.drain():
            age_ns = clock.now_ns() - received.message.beat_ns
            if received.message.beat_ns and age_ns <= stuck_ns:
                return max(0, age_ns) / 1e9
    return None


def kill(run: Path, process: str) -> bool:
    """Kill it, if it is old enough to have turned; says whether."""
    life = Lives(run).find(process)
    if life is None:
        return False
    old_enough = life.age_ns() > START_NS
    if old_enough:
        life.suffer("kill")
    life.release()
    return old_enough
