"""Carrying out faults, on the processes of a run as the system shows them."""

from __future__ import annotations

import heapq
import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Protocol

from launcher.chaos.plan import LINK, Deed, Fault
from rtcore.cast import index_of, role_of
from rtcore.clock import Clock

PROC = Path("/proc")
SLICE_NS = 100_000_000  # how long a wait goes on before the run's end is looked for
RETRY_NS = 50_000_000
SIGNALS: dict[Deed, signal.Signals] = {
    "kill": signal.SIGKILL,
    "stop": signal.SIGSTOP,
    "continue": signal.SIGCONT,
}
PATIENCE_NS = 15_000_000_000  # for a process that is between two lives


@dataclass(frozen=True, slots=True)
class Done:
    """What became of a fault: begun at `at_s` of run time; None: the process never lived for it."""

    fault: Fault
    at_s: float | None

    @property
    def until_s(self) -> float:
        """When it was over, in run time."""
        return (self.fault.at_s if self.at_s is None else self.at_s) + self.fault.for_s


class Victim(Protocol):
    """One life of a process."""

    def suffer(self, deed: Deed) -> None:
        """Do it; nothing if that life is over."""

    def release(self) -> None:
        """Undo what can be undone, whatever was done; let it go."""


class Hunter(Protocol):
    """Finds processes."""

    def find(self, process: str) -> Victim | None:
        """The life that a process has now; None: it has none."""


class Life:
    """A process of the system, held by a descriptor: its number may be another's before we are done."""

    def __init__(self, pid: int) -> None:
        """Raises ProcessLookupError if it has gone."""
        self._pid = pid
        self._descriptor = os.pidfd_open(pid)
        self._stopped = False
        self._limits: tuple[int, int] | None = None  # on the size of its files, before

    def suffer(self, deed: Deed) -> None:
        """See `Victim`."""
        with suppress(ProcessLookupError):
            if deed == "fill":
                self._fill()
            elif deed == "empty":
                self._empty()
            else:
                self._stopped = deed == "stop"
                signal.pidfd_send_signal(self._descriptor, SIGNALS[deed])

    def age_ns(self) -> int:
        """Since its beginning; 0 if it is over. That of a spare is when it began to be more than one
        (`launcher.spares`): while it waits it has one thread.
        """
        begun: list[int] = []  # its threads, in the system's ticks since the boot
        with suppress(OSError):  # the process ends meanwhile
            for path in (PROC / str(self._pid)).glob("task/*/stat"):
                with suppress(OSError):  # a thread does
                    begun.append(int(path.read_text().rpartition(")")[2].split()[19]))
        if not begun:
            return 0
        begun_s = sorted(begun)[:2][-1] / os.sysconf("SC_CLK_TCK")
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - round(begun_s * 1e9)

    def release(self) -> None:
        """See `Victim`."""
        if self._stopped:
            self.suffer("continue")
        self.suffer("empty")
        os.close(self._descriptor)

    def _fill(self) -> None:
        signal.pidfd_send_signal(self._descriptor, 0)  # is it still there?
        before = resource.prlimit(self._pid, resource.RLIMIT_FSIZE)
        resource.prlimit(self._pid, resource.RLIMIT_FSIZE, (0, before[1]))
        self._limits = before

    def _empty(self) -> None:
        limits, self._limits = self._limits, None
        if limits is not None:
            signal.pidfd_send_signal(self._descriptor, 0)
            resource.prlimit(self._pid, resource.RLIMIT_FSIZE, limits)


class Interface:
    """A network interface of this machine, to be taken down and up again: root's right."""

    def __init__(self, name: str, ip: str = "ip") -> None:
        self._name = name
        self._ip = ip
        self._cut = False

    def suffer(self, deed: Deed) -> None:
        """See `Victim`."""
        self._cut = deed == "cut"
        state = "down" if self._cut else "up"
        subprocess.run([self._ip, "link", "set", "dev", self._name, state], check=True)

    def release(self) -> None:
        """See `Victim`."""
        if self._cut:
            self.suffer("mend")


class Lives:
    """The processes of one run on this machine: `python -m <role> --run <run>`, with `--index <i>` if the
    process's name has a number.
    """

    def __init__(self, run: Path) -> None:
        self._run = str(run)

    def find(self, process: str) -> Life | None:
        """See `Hunter`."""
        for pid in self.pids(process):
            with suppress(ProcessLookupError):
                life = Life(pid)
                if self._runs(pid, process):  # still, so it is the one that is held
                    return life
                life.release()
        return None

    def pids(self, process: str) -> list[int]:
        """Those that run a process."""
        numbers = [int(entry.name) for entry in PROC.iterdir() if entry.name.isdecimal()]
        return sorted(pid for pid in numbers if self._runs(pid, process))

    def _runs(self, pid: int, process: str) -> bool:
        """Whether that is its command. One that is dead and not buried yet has none."""
        try:
            words = (PROC / str(pid) / "cmdline").read_bytes().decode(errors="replace").split("\0")
        except OSError:
            return False
        pairs = set(pairwise(words))
        wanted = {("-m", role_of(process)), ("--run", self._run)}
        if (index := index_of(process)) is not None:
            wanted.add(("--index", str(index)))
        return wanted <= pairs


class Victims:
    """The processes of a run, and the link to its other hosts."""

    def __init__(self, lives: Lives, interface: str) -> None:
        self._lives = lives
        self._interface = interface

    def find(self, process: str) -> Victim | None:
        """See `Hunter`."""
        return Interface(self._interface) if process == LINK else self._lives.find(process)


@dataclass
class _Running:
    """A fault under way: its victim, and when the first deed was done."""

    victim: Victim
    began_ns: int


@dataclass
class Execution:
    """Carries out faults in time.

    Attributes:
        done: what became of those that are over or were given up.
    """

    faults: Sequence[Fault]
    hunter: Hunter
    clock: Clock
    t0_ns: int
    done: list[Done] = field(default_factory=list)
    _running: dict[int, _Running] = field(default_factory=dict)

    def run(self, going_on: Callable[[], bool]) -> None:
        """Until all is done, or `going_on` says that the run has ended. Nobody stays stopped."""
        queue = [(self.t0_ns + round(fault.at_s * 1e9), i, 0) for i, fault in enumerate(self.faults)]
        heapq.heapify(queue)
        try:
            while queue:
                due_ns, index, step = heapq.heappop(queue)
                if not self._wait(due_ns, going_on):
                    break
                if (following_ns := self._carry_out(index, step)) is not None:
                    following = step + 1 if index in self._running else 0
                    heapq.heappush(queue, (following_ns, index, following))
        finally:
            while self._running:
                self._running.popitem()[1].victim.release()
        begun = {id(one.fault) for one in self.done}
        self.done += [Done(fault, None) for fault in self.faults if id(fault) not in begun]
        self.done.sort(key=lambda one: one.fault.at_s if one.at_s is None else one.at_s)

    def _carry_out(self, index: int, step: int) -> int | None:
        """One deed. Says when the next one of this fault is due, or the next try; None: it is over."""
        fault = self.faults[index]
        if step == 0 and not self._begin(index, fault):
            now_ns = self.clock.now_ns()
            late_ns = now_ns - self.t0_ns - round(fault.at_s * 1e9)
            return now_ns + RETRY_NS if late_ns < PATIENCE_NS else None
        one = self._running[index]
        one.victim.suffer(fault.deeds[step][1])
        if step + 1 < len(fault.deeds):
            return one.began_ns + round(fault.deeds[step + 1][0] * 1e9)
        self._running.pop(index).victim.release()
        return None

    def _begin(self, index: int, fault: Fault) -> bool:
        """Find the victim; False: it is between two lives."""
        victim = self.hunter.find(fault.process)
        if victim is None:
            return False
        now_ns = self.clock.now_ns()
        self._running[index] = _Running(victim, now_ns)
        self.done.append(Done(fault, (now_ns - self.t0_ns) / 1e9))
        return True

    def _wait(self, due_ns: int, going_on: Callable[[], bool]) -> bool:
        """Whether the run goes on when it is time."""
        while going_on():
            now_ns = self.clock.now_ns()
            if now_ns >= due_ns:
                return True
            self.clock.rest_until_ns(min(due_ns, now_ns + SLICE_NS))
        return False
