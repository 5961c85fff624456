"""The processes of a run on this machine: started together, started again, and ended in order."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import Literal

from launcher.children import Children
from launcher.restarts import Again, GiveUp, Happening, Restarts, What, describe
from launcher.starting import process_command
from launcher.vitals import Vitals
from launcher.watchdog import Watchdog
from rtcore import channels
from rtcore.cast import role_of

Reason = Literal["duration", "interrupted", "failed", "killed"]

POLL_S = 0.05
INTERRUPTED_LIMIT_S = 4.5  # from Ctrl-C to the last kill; the summary fits into what is left of 5 s
ENDING_LIMIT_S = 20.0  # when nobody is waiting: the recorder may take 10 s to compact a long recording
NOT_STARTED = 126  # exit code of a life that the system refused, as shells have it

# The world ends first, then who depends on what it sent. A role's processes get their SIGTERM when those
# of all roles before it have ended, or when this share of the time is over.
LATEST_SHARE = {channels.ENV_SERVER: 0.0, channels.AGENT: 0.2, channels.LEARNER: 0.3, channels.RECORDER: 0.7}


def command_for(process: str, run_dir: Path) -> list[str]:
    """The command line of one process under a supervisor."""
    return process_command(process, run_dir, supervisor=os.getpid())


@dataclass(frozen=True, slots=True)
class Failure:
    """A process that ended when it should not have, for the last time."""

    process: str
    code: int  # negative: the signal that ended it
    output: str  # its last lines
    why: str = ""  # it is not started again, if that was the question

    def __str__(self) -> str:
        return f"{self.process} {self.why or f'ended unexpectedly ({describe(self.code)})'}"


@dataclass
class End:
    """How a run ended."""

    reason: Reason
    failures: list[Failure] = field(default_factory=list)
    forced: list[str] = field(default_factory=list)  # killed, because they did not end in time


class Interrupts:
    """How often somebody asked for the end.

    Attributes:
        count: how often.
        first_s: when they did for the first time, on the monotonic clock.
    """

    def __init__(self) -> None:
        self.count = 0
        self.first_s = math.inf

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Count SIGINT, SIGTERM and, unless it is ignored as under nohup, SIGHUP inside the block."""

        def handle(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - the signal module's signature
            self.first_s = min(self.first_s, time.monotonic())
            self.count += 1

        numbers = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            numbers.append(signal.SIGHUP)
        previous = {number: signal.signal(number, handle) for number in numbers}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


class OrderlyEnd:
    """Who gets which signal when. Pure: it is told the time and who still runs."""

    def __init__(self, order: Sequence[str], begin_s: float, limit_s: float) -> None:
        self._order = tuple(order)
        self._begin_s = begin_s
        self.limit_s = limit_s
        self._asked: set[str] = set()

    def hurry(self, now_s: float, limit_s: float) -> None:
        """Be done `limit_s` from now, if that is sooner."""
        self.limit_s = min(self.limit_s, now_s - self._begin_s + limit_s)

    def due(self, now_s: float, running: frozenset[str]) -> list[tuple[str, signal.Signals]]:
        """The signals to send now."""
        elapsed_s = now_s - self._begin_s
        if elapsed_s >= self.limit_s:
            return [(process, signal.SIGKILL) for process in self._order if process in running]
        found: list[tuple[str, signal.Signals]] = []
        earlier_ended = True
        for role, processes in groupby(self._order, role_of):
            going_on = [process for process in processes if process in running]
            if earlier_ended or elapsed_s >= LATEST_SHARE.get(role, 0.0) * self.limit_s:
                found += [(process, signal.SIGTERM) for process in going_on if process not in self._asked]
            earlier_ended = earlier_ended and not going_on
        self._asked.update(process for process, _ in found)
        return found


class Supervisor:
    """Child processes by name, in connect order; the orderly end of all of the first role ends the run."""

    def __init__(
        self,
        commands: Mapping[str, Sequence[str]],
        output_dir: Path,
        *,
        spares: Mapping[str, Sequence[str]] = {},
        restarts: Restarts | None = None,
        vitals: Vitals | None = None,
        tell: Callable[[Happening], None] = lambda happening: None,  # noqa: ARG005 - nobody listens
    ) -> None:
        """Args:
        commands: a command line per process.
        output_dir: what they print is in `<process>.out` there.
        spares: a command line per role of which one process waits, loaded, to be the next life.
        restarts: decides on who died; None: any death ends the run.
        vitals: says who is stuck, which whoever calls `supervise` keeps informed; None: nobody ever is.
        tell: called with what happens.
        """
        self._children = Children(commands, output_dir, spares)
        self._restarts = restarts
        self._vitals = vitals
        self._watchdog = None if vitals is None else Watchdog(vitals, self._children.pid)
        self._tell = tell
        self._dead: set[str] = set()  # whose death has been entered
        self._due_ns: dict[str, int] = {}  # of the dead: when their next life begins
        self._hung: set[str] = set()  # killed for that, and not seen to end yet
        self._leaders = {name for name in commands if role_of(name) == role_of(next(iter(commands)))}
        self._done: set[str] = set()  # of the leaders: who has ended in order

    @contextmanager
    def started(self) -> Iterator[None]:
        """Start all; whatever still runs when the block is left is killed."""
        with self._children.kept():
            for process in self._children.names:
                self._start(process)
            yield

    def running(self) -> frozenset[str]:
        """Who runs."""
        return self._children.running()

    def ended_well(self, process: str) -> bool:
        """Whether its last life ended with exit code 0."""
        return self._children.exits().get(process) == 0

    def supervise(self, interrupts: Interrupts, on_poll: Callable[[frozenset[str]], None]) -> End:
        """Start again who dies, until the run's end, and carry that out: all leaders have ended by
        themselves, one process is given up, or somebody interrupts (twice: kill at once).

        Args:
            interrupts: counts them.
            on_poll: called every 50 ms with the processes that are being waited for to end; none of
                them while the run goes on.
        """
        end = self._wait(interrupts, on_poll)
        limit_s = INTERRUPTED_LIMIT_S if end.reason == "interrupted" else ENDING_LIMIT_S
        plan = OrderlyEnd(self._children.names, time.monotonic(), limit_s)
        asked_before = interrupts.count
        hurried = end.reason == "interrupted"
        while running := self.running():
            if interrupts.count >= 2:
                self._children.kill(running)
                end.reason = "killed"
                break
            if interrupts.count > asked_before and not hurried:
                hurried = True
                plan.hurry(time.monotonic(), INTERRUPTED_LIMIT_S)
            self._send(plan.due(time.monotonic(), running), end)
            on_poll(running)
            time.sleep(POLL_S)
        self._judge_ending(end)
        return end

    def _wait(self, interrupts: Interrupts, on_poll: Callable[[frozenset[str]], None]) -> End:
        """Until there is a reason to end."""
        while not interrupts.count:
            exits = {name: n for name, n in self._children.exits().items() if name not in self._dead}
            self._note_done(exits)
            over = self._done == self._leaders
            bad = {name: n for name, n in exits.items() if n != 0 or not (over or name in self._done)}
            failures = [failure for name, n in bad.items() if (failure := self._died(name, n))]
            if over:
                return End("duration", failures)
            self._kill_stuck()
            failures += self._start_due()
            self._children.tend(time.monotonic())
            if failures:
                return End("failed", failures)
            on_poll(frozenset())
            time.sleep(POLL_S)
        return End("interrupted")

    def _note_done(self, exits: Mapping[str, int]) -> None:
        """An environment that ended in order before the others is through; nothing more is expected of it."""
        for process in self._leaders - self._done:
            if exits.get(process) == 0:
                self._done.add(process)
                if self._vitals is not None:
                    self._vitals.gone(process)

    def _died(self, process: str, code: int, error: OSError | None = None) -> Failure | None:
        """Enter a death, or that a life could not begin; a failure if it is the last one."""
        what: What = "stuck" if process in self._hung else "died"
        how = f"died ({describe(code)})" if error is None else f"cannot be started ({error})"
        how = "hung and was killed" if what == "stuck" else how
        self._dead.add(process)
        self._hung.discard(process)
        if self._vitals is not None:
            self._vitals.gone(process)
        verdict: Again | GiveUp = GiveUp("")
        if self._restarts is not None:
            verdict = self._restarts.died(process, time.monotonic(), code, hung=what == "stuck")
        if isinstance(verdict, Again):
            self._due_ns[process] = time.monotonic_ns() + round(verdict.delay_s * 1e9)
            self._happened(process, what, code, f"{how}; it is started again in {verdict.delay_s:.2g} s")
            return None
        self._happened(process, what, code, how)
        failure = Failure(process, code, self._children.tail(process), verdict.why)
        self._tell(Happening(time.monotonic_ns(), process, "gave_up", code, f"{failure}: the run ends"))
        return failure

    def _kill_stuck(self) -> None:
        if self._watchdog is None:
            return
        for process in self._watchdog.hung(time.monotonic_ns()):
            self._hung.add(process)
            self._children.signal(process, signal.SIGKILL)
        for process in self._watchdog.starving():
            self._happened(process, "starved", None, "does not say that its loop turns: it waits for a core")

    def _start_due(self) -> list[Failure]:
        now_ns = time.monotonic_ns()
        failures: list[Failure] = []
        for process in [name for name, due_ns in self._due_ns.items() if now_ns >= due_ns]:
            del self._due_ns[process]
            try:
                spared = self._start(process)
            except OSError as error:  # no memory, no file descriptors: that may pass
                failure = self._died(process, NOT_STARTED, error)
                failures += [failure] if failure else []
            else:
                self._happened(process, "restarted", None, "is started again" + " from its spare" * spared)
        return failures

    def _start(self, process: str) -> bool:
        spared = self._children.start(process)
        self._dead.discard(process)
        if self._vitals is not None:
            self._vitals.started(process)
        return spared

    def _happened(self, process: str, what: What, code: int | None, text: str) -> None:
        self._tell(Happening(time.monotonic_ns(), process, what, code, f"{process} {text}"))

    def _send(self, due: Sequence[tuple[str, signal.Signals]], end: End) -> None:
        for process, number in due:
            if number is signal.SIGKILL:
                end.forced.append(process)
                self._children.kill({process})
            else:
                self._children.signal(process, number)

    def _judge_ending(self, end: End) -> None:
        """Who ended badly while being ended. Not who died of our signals: of SIGTERM, when it had only
        just been started and had no handler yet. Who was killed by somebody else is told, no more.
        """
        for process, code in self._children.exits().items():
            if process in self._dead or process in end.forced or code in (0, -signal.SIGTERM):
                continue
            if code != -signal.SIGKILL:
                end.failures.append(Failure(process, code, self._children.tail(process)))
            if end.reason != "killed":
                self._happened(process, "died", code, f"died while it was to end ({describe(code)})")
