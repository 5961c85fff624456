"""Child processes by name, each in one life at a time."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from launcher.spares import Spares
from rtcore.cast import role_of

TAIL_LINES = 12


class Children:
    """Starts, signals and buries. What the lives of a process print is in one file, `<name>.out`."""

    def __init__(
        self,
        commands: Mapping[str, Sequence[str]],
        output_dir: Path,
        spares: Mapping[str, Sequence[str]] = {},
    ) -> None:
        """Args:
        commands: a command line per process.
        output_dir: for what they print.
        spares: a command line per role of which one process is to be in reserve.
        """
        self._commands = dict(commands)
        self._output_dir = output_dir
        self._spare_commands = dict(spares)
        self._spares = Spares(spares, self._start_spare)
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._starter: ThreadPoolExecutor | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """In the order of their commands."""
        return tuple(self._commands)

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Children may live inside the block; whatever still runs when it is left is killed."""
        # All are started by one thread that is older than anything done to this one, and lives as long as
        # they may: a child inherits its starter's niceness and cores, which the launcher gives up for itself,
        # and gets SIGTERM when the thread that started it ends.
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="starter") as self._starter:
            self._starter.submit(lambda: None).result()
            try:
                yield
            finally:
                self.kill(self.running())
                self._spares.end()

    def start(self, name: str) -> bool:
        """Begin a life; says whether a spare took it on.

        Raises:
            OSError: the system refuses.
        """
        command, output = self._commands[name], self._output_dir / f"{name}.out"
        spare = self._spares.take(role_of(name), command, output)
        self._children[name] = spare or self._popen(command, output, subprocess.DEVNULL)
        self._spares.began(role_of(name), time.monotonic())
        return spare is not None

    def tend(self, now_s: float) -> None:
        """See to the spares, `now_s` by the monotonic clock. To be called many times a second."""
        self._spares.tend(now_s)

    def pid(self, name: str) -> int:
        """The number of its life, which may be over."""
        return self._children[name].pid

    def running(self) -> frozenset[str]:
        """Who runs."""
        return frozenset(name for name, child in self._children.items() if child.poll() is None)

    def exits(self) -> dict[str, int]:
        """Exit codes of those that ended; negative: the signal."""
        codes = {name: child.poll() for name, child in self._children.items()}
        return {name: code for name, code in codes.items() if code is not None}

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal, if it still runs; waits for nothing."""
        with contextlib.suppress(ProcessLookupError):
            self._children[name].send_signal(number)

    def kill(self, names: Iterable[str]) -> None:
        """Kill, and wait for the end."""
        for name in names:
            self.signal(name, signal.SIGKILL)
        for name in names:
            self._children[name].wait()

    def tail(self, name: str) -> str:
        """The last lines that it printed, in this life or an earlier one."""
        try:
            text = (self._output_dir / f"{name}.out").read_text(errors="replace")
        except OSError as error:
            return f"(not to be read: {error})"
        return "\n".join([line for line in text.splitlines() if line.strip()][-TAIL_LINES:])

    def _start_spare(self, role: str) -> subprocess.Popen[bytes]:
        return self._popen(
            self._spare_commands[role], self._output_dir / f"{role}.spare.out", subprocess.PIPE
        )

    def _popen(self, command: Sequence[str], output: Path, stdin: int) -> subprocess.Popen[bytes]:
        # One file for both streams keeps their order. A process group of its own keeps the terminal's
        # Ctrl-C from it; a session of its own would make it an autogroup of its own, against whose CPU
        # share no niceness helps.
        def popen() -> subprocess.Popen[bytes]:
            with output.open("ab") as file:
                return subprocess.Popen(
                    command, stdin=stdin, stdout=file, stderr=subprocess.STDOUT, process_group=0
                )

        assert self._starter is not None, "inside `kept` only"
        return self._starter.submit(popen).result()
