"""The processes of a run, started one by one so that each can be killed, and a reader of the log."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from rtcore import channels
from rtcore.bus import Bus
from rtcore.config import RunConfig
from rtcore.messages import Step
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import open_bus

ROOT = Path(__file__).parents[2]
LIMIT_S = 30.0


class Cast:
    """Who is on, and all steps that were logged so far."""

    def __init__(self, run: RunDir, bus: Bus) -> None:
        self.run = run
        self.bus = bus
        self.clock = MonotonicClock()
        self.steps: list[Step] = []
        self._log = bus.queue(channels.LOG, "*")
        self._on: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, *roles: str) -> int:
        """Start them; the instant right before."""
        begun_ns = self.clock.now_ns()
        for role in roles:
            self._on[role] = subprocess.Popen(
                [sys.executable, "-m", role, "--run", str(self.run.path)], cwd=ROOT
            )
        return begun_ns

    def send(self, role: str, number: signal.Signals) -> int:
        """Send a signal; the instant right after. SIGKILL is waited for."""
        self._on[role].send_signal(number)
        if number is signal.SIGKILL:
            self._on.pop(role).wait(LIMIT_S)
        return self.clock.now_ns()

    def stop_for(self, role: str, seconds: float) -> tuple[int, int]:
        """SIGSTOP and SIGCONT; from the instant after the one to the instant before the other."""
        stopped_ns = self.send(role, signal.SIGSTOP)
        self.watch(seconds)
        going_on_ns = self.clock.now_ns()
        self.send(role, signal.SIGCONT)
        return stopped_ns, going_on_ns

    def end(self, role: str) -> int:
        """Let one end by itself, or after SIGTERM if it is not the env server; its exit code."""
        if role != channels.ENV_SERVER:
            self._on[role].terminate()
        return self._on.pop(role).wait(LIMIT_S)

    def read(self) -> list[Step]:
        """New steps of the log."""
        new = [step for received in self._log.drain() for step in received.message.steps]
        self.steps += new
        return new

    def watch(self, seconds: float) -> None:
        """Read the log for so long."""
        self.watch_until(lambda: False, seconds)

    def watch_until(self, happened: Callable[[], bool], limit_s: float = LIMIT_S) -> None:
        """Read the log until something has happened, at most so long."""
        deadline = time.monotonic() + limit_s
        while not happened() and (remaining := deadline - time.monotonic()) > 0:
            self._log.wait(min(remaining, 0.05))
            self.read()

    def close(self) -> None:
        """Kill who is still on."""
        for process in self._on.values():
            process.kill()
            process.wait(LIMIT_S)


@contextmanager
def cast(path: Path, config: RunConfig) -> Iterator[Cast]:
    """A new run in `path`, with nobody on but a client that reads the log."""
    run = RunDir.create(path, config)
    with ExitStack() as stack:
        stack.callback(run.remove_socket_dir)
        bus = open_bus("client", run.run_name, run.socket_dir(), clock=MonotonicClock())
        found = Cast(run, stack.enter_context(bus))
        stack.callback(found.close)
        yield found
