"""Scheduling, cores and memory of a process: decided by `plan`, carried out by `apply`, told by `Placement`.

Measured on two cores beside a learner (1 kHz ticks, p50/p99/p99.9 of the wake-up error in us): 0.1/569/3333
with normal scheduling, 0.1/0.6/82 with SCHED_FIFO. But FIFO threads left free to move raise the bus's
p50 (170 -> 272 us round trip), each hop waking another core; so FIFO goes with one core for the env server
and the agent together, and the learner and the recorder keep off it.
"""

from __future__ import annotations

import contextlib
import gc
import os
import resource
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rtcore import libc
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER
from rtcore.config import ConfigError
from rtcore.crew import ALONE, Crew

Rt = Literal["auto", "off", "require"]
Collector = Literal["frozen", "on"]

FIFO_PRIORITY = 50  # the measured one: above ordinary threads, level with the kernel's interrupt threads
BACKGROUND_PRIORITY = 1  # of the threads beside those that act
TIMER_SLACK_NS = 1  # the default of 50 us is added to every sleep: p50 83 -> 43 us without it
NICE = {LEARNER: 5, RECORDER: 10}  # ranks only within one session (autogroup): start all from one launcher
# How long a thread that acts waits, at most, for the interpreter while another one computes; Python's 5 ms
# are a whole period at 200 Hz.
SWITCH_INTERVAL_S = 5e-5
# On fault: locking what is merely reserved grew a small process from 28 to 171 MB.
LOCK_FLAGS = libc.MCL_CURRENT | libc.MCL_FUTURE | libc.MCL_ONFAULT
CAP_IPC_LOCK, CAP_SYS_NICE = 14, 23

FIFO, PINNING, MEMORY, SLACK, NICENESS = "SCHED_FIFO", "pinning", "locked memory", "timer slack", "nice"
GRANTS = {
    FIFO: f"sudo prlimit --pid $$ --rtprio={FIFO_PRIORITY}",
    MEMORY: "sudo prlimit --pid $$ --memlock=unlimited",
    PINNING: "allow sched_setaffinity in the sandbox",
    SLACK: "allow prctl in the sandbox",
    NICENESS: "allow setpriority in the sandbox",
}


class RealtimeError(RuntimeError):
    """`agent.rt = "require"`, and the system refuses something."""

    def __init__(self, role: str, missing: Sequence[str]) -> None:
        super().__init__(
            f"agent.rt = 'require': {role} is refused {', '.join(missing)}; to grant it:"
            f" {how_to_grant(missing)}; then start again from that shell (`tenuto doctor` knows other ways)"
        )
        self.missing = tuple(missing)


def how_to_grant(missing: Sequence[str]) -> str:
    """The commands that give what a `Placement` misses, for the shell that starts Tenuto."""
    return "; ".join(GRANTS[what] for what in missing)


@dataclass(frozen=True, slots=True)
class Privileges:
    """What the system lets this process ask for."""

    max_priority: int  # highest SCHED_FIFO priority; 0: none
    lock_memory: bool  # without limit


@dataclass(frozen=True, slots=True)
class Plan:
    """What to ask for. None and () leave things as they are."""

    role: str
    fifo_priority: int | None
    cores: tuple[int, ...]
    nice: int | None  # at least this
    lock_memory: bool
    freeze_collector: bool
    missing: tuple[str, ...]  # wanted, but known to be refused


@dataclass(frozen=True, slots=True)
class Placement:
    """What was obtained, read back from the system."""

    role: str
    scheduler: str  # "SCHED_FIFO 50" or "SCHED_OTHER"
    nice: int
    cores: tuple[int, ...]
    memory_locked: bool
    timer_slack_ns: int  # a SCHED_FIFO task has none, and newer kernels say 0
    collector: Collector
    missing: tuple[str, ...]  # wanted, but refused

    def describe(self) -> str:
        """One line for the log and the run card."""
        cores = f"core{'s' if len(self.cores) != 1 else ''} {','.join(map(str, self.cores))}"
        memory = "memory locked" if self.memory_locked else "memory not locked"
        line = (
            f"{self.scheduler}, nice {self.nice}, {cores}, {memory}, timer slack {self.timer_slack_ns} ns,"
            f" collector {self.collector}"
        )
        return f"{line}; refused: {', '.join(self.missing)}" if self.missing else line


def enter(role: str, rt: Rt, crew: Crew = ALONE) -> Placement:
    """Give this process its place. Call it before threads start and the bus opens: they inherit it.

    Args:
        role: one of `channels.PROCESSES`.
        rt: "auto": as much as the system grants; "require": all of it; "off": only what costs the rest
            of the machine nothing, the timer slack and the collector.
        crew: the pairs of env server and agent that there are.

    Raises:
        RealtimeError: "require", and the system refuses something.
        ConfigError: no such role.
    """
    placement = apply(plan(role, rt, allowed_cores(), privileges(), crew))
    if rt == "require" and placement.missing:
        raise RealtimeError(role, placement.missing)
    return placement


def step_back() -> None:
    """Put the calling thread behind those that act: SCHED_FIFO too, where they have it, but lowest.

    For work beside the ticks: at the same priority a thread is not preempted, so a hash of a millisecond
    would delay a tick by as much. With ordinary scheduling it is preempted by anybody on the core, for
    milliseconds, and may hold the interpreter meanwhile, which a tick then waits for.
    """
    if hasattr(os, "sched_setscheduler") and os.sched_getscheduler(0) == os.SCHED_FIFO:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(BACKGROUND_PRIORITY))


@contextlib.contextmanager
def out_of_the_way(rt: Rt, crew: Crew = ALONE) -> Iterator[None]:
    """Keep a process that only watches off the acting pairs' cores, if there is another, inside the block.

    Enter it once the processes that are watched have been started: they would inherit it.
    """
    allowed = allowed_cores()
    others = allowed[crew.cores(len(allowed)) :]
    if rt == "off" or not others:
        yield
        return
    with contextlib.suppress(OSError, AttributeError):  # refused: then it shares the core
        pin(others)
    try:
        yield
    finally:
        with contextlib.suppress(OSError, AttributeError):
            pin(allowed)


def plan(role: str, rt: Rt, allowed: Sequence[int], granted: Privileges, crew: Crew = ALONE) -> Plan:
    """Decide, without touching anything.

    Args:
        role: one of `channels.PROCESSES`.
        rt: see `enter`.
        allowed: the cores that this process may use, at least one.
        granted: see `privileges`.
        crew: the pairs of env server and agent that there are.
    """
    if role not in PROCESSES:
        raise ConfigError("role", role, f"must be one of {', '.join(PROCESSES)}")
    acting = role in (ENV_SERVER, AGENT)
    if rt == "off":
        return Plan(role, None, (), None, lock_memory=False, freeze_collector=acting, missing=())
    cores = sorted(allowed)
    pairs = cores[: crew.cores(len(cores))]
    if not acting:
        others = tuple(cores[len(pairs) :] or cores)
        return Plan(role, None, others, NICE[role], lock_memory=False, freeze_collector=False, missing=())
    missing = {FIFO: granted.max_priority <= BACKGROUND_PRIORITY, MEMORY: not granted.lock_memory}
    return Plan(
        role,
        fifo_priority=None if missing[FIFO] else min(FIFO_PRIORITY, granted.max_priority),
        # Together on one core even without FIFO: loop p50/p99 at 500 Hz beside a learner 242/593 us,
        # misses 0.04 %, against 298/1364 us and 1.2 % with everything free to move.
        cores=(pairs[crew.number % len(pairs)],),
        nice=None,
        lock_memory=granted.lock_memory,
        freeze_collector=True,
        missing=tuple(what for what, is_missing in missing.items() if is_missing),
    )


def apply(planned: Plan) -> Placement:
    """Ask for what is planned. What the system refuses is in `missing`; nothing is raised for it."""
    missing = list(planned.missing)

    def attempt(what: str, ask: Callable[[], object]) -> bool:
        try:
            ask()
        except (OSError, AttributeError):  # AttributeError: this system's Python has no such call
            missing.append(what)
            return False
        return True

    # The slack first: a FIFO task has none, and newer kernels then ignore the request.
    attempt(SLACK, lambda: libc.prctl(libc.PR_SET_TIMERSLACK, TIMER_SLACK_NS))
    cores, nice, priority = planned.cores, planned.nice, planned.fifo_priority
    pinned = bool(cores) and attempt(PINNING, lambda: pin(cores))
    if nice is not None:
        attempt(NICENESS, lambda: _be_nice(nice))
    locked = planned.lock_memory and attempt(MEMORY, lambda: libc.mlockall(LOCK_FLAGS))
    if planned.freeze_collector:  # no pause in a tick; free, though no gain could be measured at 1 kHz
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        # No collection first: it takes 23 ms of an agent's start, and finds 400 objects.
        gc.freeze()
        gc.disable()
    if priority is not None:  # last: locking takes 3 ms, which would be a world's ticks
        if pinned:
            attempt(FIFO, lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority)))
        else:
            missing.append(FIFO)
    return Placement(
        planned.role,
        scheduler=_scheduler(),
        nice=os.getpriority(os.PRIO_PROCESS, 0),
        cores=allowed_cores(),
        memory_locked=locked,
        timer_slack_ns=_timer_slack_ns(),
        collector="on" if gc.isenabled() else "frozen",
        missing=tuple(missing),
    )


def pin(cores: Sequence[int]) -> None:
    """Keep all of this process's threads, and those that they start, to these cores.

    Raises:
        OSError: refused, or none of the cores exists.
        AttributeError: this system's Python has no such call.
    """
    for thread in _threads():
        with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(thread, cores)


def allowed_cores() -> tuple[int, ...]:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or 1))


def privileges() -> Privileges:
    """Read what this process may ask for from its limits and capabilities."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    capabilities = next((int(line.split()[1], 16) for line in lines if line.startswith("CapEff:")), 0)
    priority_limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    memory_limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    any_priority = bool(capabilities >> CAP_SYS_NICE & 1) or priority_limit == resource.RLIM_INFINITY
    return Privileges(
        max_priority=99 if any_priority else priority_limit,
        lock_memory=bool(capabilities >> CAP_IPC_LOCK & 1) or memory_limit == resource.RLIM_INFINITY,
    )


def _threads() -> list[int]:
    """This process's threads: numerical libraries start some on import, and each has settings of its own."""
    tasks = Path("/proc/self/task")
    return [int(task.name) for task in tasks.iterdir()] if tasks.exists() else [0]


def _be_nice(nice: int) -> None:
    for thread in _threads():
        os.setpriority(os.PRIO_PROCESS, thread, max(nice, os.getpriority(os.PRIO_PROCESS, thread)))


def _scheduler() -> str:
    if not hasattr(os, "sched_getscheduler"):
        return "SCHED_OTHER"
    names = {os.SCHED_OTHER: "SCHED_OTHER", os.SCHED_BATCH: "SCHED_BATCH", os.SCHED_IDLE: "SCHED_IDLE"}
    policy = os.sched_getscheduler(0)
    if policy in (os.SCHED_FIFO, os.SCHED_RR):
        name = "SCHED_FIFO" if policy == os.SCHED_FIFO else "SCHED_RR"
        return f"{name} {os.sched_getparam(0).sched_priority}"
    return names.get(policy, f"policy {policy}")


def _timer_slack_ns() -> int:
    try:
        return libc.prctl(libc.PR_GET_TIMERSLACK)
    except OSError:
        return 0
