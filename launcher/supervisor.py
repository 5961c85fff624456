"""The processes of a run on this machine: started together, watched, and ended in order."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Literal

from rtcore import channels

Reason = Literal["duration", "interrupted", "failed", "killed"]

POLL_S = 0.05
INTERRUPTED_LIMIT_S = 4.5  # from Ctrl-C to the last kill; the summary fits into what is left of 5 s
ENDING_LIMIT_S = 20.0  # when nobody is waiting: the recorder may take 10 s to compact a long recording
TAIL_LINES = 12

# The world ends first, then who depends on what it sent. A process gets its SIGTERM when all before
# it have ended, or when this share of the time is over.
LATEST_SHARE = {channels.ENV_SERVER: 0.0, channels.AGENT: 0.2, channels.LEARNER: 0.3, channels.RECORDER: 0.7}


def command_for(process: str, run_dir: Path) -> list[str]:
    """The command line of one process under a supervisor."""
    return [sys.executable, "-m", process, "--run", str(run_dir), "--supervised", str(os.getpid())]


@dataclass(frozen=True, slots=True)
class Failure:
    """A process that ended when it should not have."""

    process: str
    code: int  # negative: the signal that ended it
    output: str  # its last lines

    def __str__(self) -> str:
        how = f"exit code {self.code}" if self.code >= 0 else f"signal {signal.Signals(-self.code).name}"
        return f"{self.process} ended unexpectedly ({how})"


@dataclass
class End:
    """How a run ended."""

    reason: Reason
    failures: list[Failure] = field(default_factory=list)
    forced: list[str] = field(default_factory=list)  # killed, because they did not end in time


class Interrupts:
    """How often somebody asked for the end."""

    def __init__(self) -> None:
        self.count = 0

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Count SIGINT, SIGTERM and, unless it is ignored as under nohup, SIGHUP inside the block."""

        def handle(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - the signal module's signature
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
        for process in self._order:
            latest_s = LATEST_SHARE.get(process, 0.0) * self.limit_s
            its_turn = earlier_ended or elapsed_s >= latest_s
            if its_turn and process in running and process not in self._asked:
                self._asked.add(process)
                found.append((process, signal.SIGTERM))
            earlier_ended = earlier_ended and process not in running
        return found


class Supervisor:
    """Child processes by name; the first of them is the one whose orderly end ends the run."""

    def __init__(self, commands: Mapping[str, Sequence[str]], output_dir: Path) -> None:
        self._commands = dict(commands)
        self._output_dir = output_dir
        self._children: dict[str, subprocess.Popen[bytes]] = {}

    @contextmanager
    def started(self) -> Iterator[None]:
        """Start all; whatever still runs when the block is left is killed."""
        try:
            for process in self._commands:
                self._start(process)
            yield
        finally:
            self._kill(self.running())

    def running(self) -> frozenset[str]:
        """Who runs."""
        return frozenset(name for name, child in self._children.items() if child.poll() is None)

    def supervise(self, interrupts: Interrupts, on_poll: Callable[[frozenset[str]], None]) -> End:
        """Wait for the run's end and carry it out: the first process ends by itself, another one
        dies, or somebody interrupts (twice: kill at once).

        Args:
            interrupts: counts them.
            on_poll: called every 50 ms with the processes that are being waited for to end; none of
                them while the run goes on.
        """
        end = self._wait(interrupts, on_poll)
        limit_s = INTERRUPTED_LIMIT_S if end.reason == "interrupted" else ENDING_LIMIT_S
        plan = OrderlyEnd(tuple(self._commands), time.monotonic(), limit_s)
        asked_before = interrupts.count
        hurried = end.reason == "interrupted"
        while running := self.running():
            if interrupts.count >= 2:
                self._kill(running)
                end.reason = "killed"
                break
            if interrupts.count > asked_before and not hurried:
                hurried = True
                plan.hurry(time.monotonic(), INTERRUPTED_LIMIT_S)
            self._send(plan.due(time.monotonic(), running), end)
            on_poll(running)
            time.sleep(POLL_S)
        end.failures += self._failures(already={one.process for one in end.failures}, forced=end.forced)
        return end

    def _wait(self, interrupts: Interrupts, on_poll: Callable[[frozenset[str]], None]) -> End:
        """Until there is a reason to end."""
        leader = next(iter(self._commands))
        while not interrupts.count:
            codes = {name: child.poll() for name, child in self._children.items()}
            exits = {name: code for name, code in codes.items() if code is not None}
            bad = [name for name, code in exits.items() if name != leader or code != 0]
            if exits.get(leader) == 0:
                return End("duration", [self._failure(name) for name in bad if exits[name] != 0])
            if bad:
                return End("failed", [self._failure(name) for name in bad])
            on_poll(frozenset())
            time.sleep(POLL_S)
        return End("interrupted")

    def _start(self, process: str) -> None:
        # One file for both streams keeps their order. A process group of its own keeps the terminal's
        # Ctrl-C from it; a session of its own would make it an autogroup of its own, against whose CPU
        # share no niceness helps.
        with (self._output_dir / f"{process}.out").open("ab") as output:
            self._children[process] = subprocess.Popen(
                self._commands[process],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                process_group=0,
            )

    def _send(self, due: Sequence[tuple[str, signal.Signals]], end: End) -> None:
        for process, number in due:
            if number is signal.SIGKILL:
                end.forced.append(process)
                self._kill(frozenset({process}))
            else:
                self._children[process].send_signal(number)

    def _kill(self, processes: frozenset[str]) -> None:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                self._children[process].kill()
        for process in processes:
            self._children[process].wait()

    def _failures(self, already: set[str], forced: Sequence[str]) -> list[Failure]:
        """Who ended badly while being ended. Not who died of our signals: of SIGTERM, when it had only
        just been started and had no handler yet.
        """
        codes = {name: child.returncode for name, child in self._children.items()}
        excused = (0, -signal.SIGKILL, -signal.SIGTERM)
        return [
            self._failure(name)
            for name, code in codes.items()
            if code not in excused and name not in already and name not in forced
        ]

    def _failure(self, process: str) -> Failure:
        text = (self._output_dir / f"{process}.out").read_text(errors="replace")
        tail = [line for line in text.splitlines() if line.strip()][-TAIL_LINES:]
        return Failure(process, self._children[process].returncode, "\n".join(tail))
