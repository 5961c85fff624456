"""How a process ends in order, and says no more than can be read."""

from __future__ import annotations

import logging
import mmap
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

from rtcore import libc


class Stop:
    """A flag that is set once, from any thread or signal handler, and that can be waited on.

    Not a `threading.Event`: its lock is not re-entrant, so a handler that sets one deadlocks when it
    interrupts that Event's own `wait` or `set` (seen within 6 s of a signal every 4 ms). Nor a
    `queue.SimpleQueue`: in Python 3.11 a `get` with a timeout never returns if a signal is handled on its
    thread after the timeout has passed, as when the process was stopped meanwhile.
    """

    def __init__(self) -> None:
        self._is_set = False
        self._reason = ""
        self._gate = threading.Lock()  # closed until the flag is set
        self._gate.acquire()

    def set(self, reason: str) -> None:
        """Stop. Only the first reason is kept."""
        if not self._is_set:
            self._reason = reason
            self._is_set = True
        self._open()

    def is_set(self) -> bool:
        """Whether `set` was called."""
        return self._is_set

    def wait(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` seconds for the flag; say whether it is set."""
        if not self._is_set and self._gate.acquire(timeout=max(0.0, timeout_s)):
            self._open()  # for the other waiters
        return self._is_set

    def _open(self) -> None:
        with suppress(RuntimeError):  # it is open
            self._gate.release()

    @property
    def reason(self) -> str:
        """Why, in a few words; empty while the flag is not set."""
        return self._reason


@contextmanager
def stop_on_signals(stop: Stop) -> Iterator[None]:
    """The first SIGINT or SIGTERM inside the block sets `stop`; then the previous handlers are back.

    So a second one ends the process as if there were no block: an impatient Ctrl-C is a
    KeyboardInterrupt. Main thread only (ValueError elsewhere).
    """

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    def handle(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - the signal module's signature
        restore()
        stop.set(signal.Signals(number).name)

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        restore()


class Continuations:
    """The instants at which this process was continued after a stop (SIGSTOP, Ctrl-Z, a debugger), in ns.

    A stop cannot be caught, its end can. But Python runs handlers on the main thread, and on a busy core
    that one got its turn up to 5 ms after the thread that acts. So the interpreter's own handler, which runs
    on whichever thread is first, also writes the signal's number into a file that is mapped here, and any
    thread may look there: 0.1 us. The newest 16 instants are kept.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._arrived: mmap.mmap | None = None  # numbers of the signals so far, then zeros
        self._read = 0
        self._reading = threading.Lock()
        self._all: deque[int] = deque(maxlen=16)
        self._untold: deque[int] = deque(maxlen=16)

    def newest_ns(self) -> int:
        """The last one, stamped now if nobody saw it yet; 0: there was none. From any thread."""
        self._look()
        return self._all[-1] if self._all else 0

    def all_ns(self) -> Sequence[int]:
        """All that are kept, oldest first."""
        self._look()
        return tuple(self._all)

    def untold_ns(self) -> Iterator[int]:
        """Those that this did not give before."""
        self._look()
        while self._untold:
            yield self._untold.popleft()

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Watch inside the block, for the first 4095 signals. Main thread only (ValueError elsewhere)."""
        file = os.memfd_create("signals")
        os.truncate(file, mmap.PAGESIZE)
        os.set_blocking(file, False)  # the interpreter insists
        self._arrived, self._read = mmap.mmap(file, mmap.PAGESIZE, prot=mmap.PROT_READ), 0
        previous_file = signal.set_wakeup_fd(file)
        previous = signal.signal(signal.SIGCONT, lambda number, frame: self._look())  # noqa: ARG005
        try:
            yield
        finally:
            signal.signal(signal.SIGCONT, previous)
            signal.set_wakeup_fd(previous_file)
            os.close(file)
            self._arrived = None  # not closed: another thread may be looking

    def _look(self) -> None:
        arrived = self._arrived
        if arrived is None or not arrived[self._read] or not self._reading.acquire(blocking=False):
            return  # nothing new, or another thread, or the one that a signal interrupted, is at it
        try:
            while self._read < mmap.PAGESIZE - 1 and arrived[self._read]:
                continued = arrived[self._read] == signal.SIGCONT
                self._read += 1
                if continued:
                    self._all.append(self._now_ns())
                    self._untold.append(self._all[-1])
        finally:
            self._reading.release()


def die_with_parent(parent_pid: int | None = None) -> bool:
    """Have the kernel send SIGTERM to this process when its parent ends, even by kill -9.

    Linux only, and "parent" is the thread that started this process: start processes from a thread
    that lives as long as they should.

    Args:
        parent_pid: the parent as it was at the start; if it has gone already, SIGTERM comes at once.

    Returns:
        False where the system does not offer it.
    """
    try:
        libc.prctl(libc.PR_SET_PDEATHSIG, signal.SIGTERM)
    except OSError:
        return False
    if parent_pid is not None and os.getppid() != parent_pid:
        os.kill(os.getpid(), signal.SIGTERM)
    return True


class RateLimited:
    """Logs at most one line per period; counts the others, and says how many with the next line.

    Thread-safe. Use one per kind of complaint.
    """

    def __init__(
        self, logger: logging.Logger, period_s: float, *, now_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._logger = logger
        self._period_ns = round(period_s * 1e9)
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._next_ns: int | None = None
        self._suppressed_since = 0
        self._suppressed = 0

    @property
    def suppressed(self) -> int:
        """Lines not logged so far."""
        return self._suppressed

    def warning(self, text: str, *arguments: object) -> bool:
        """Log a warning, or count it; see `log`."""
        return self.log(logging.WARNING, text, *arguments)

    def error(self, text: str, *arguments: object) -> bool:
        """Log an error, or count it; see `log`."""
        return self.log(logging.ERROR, text, *arguments)

    def log(self, level: int, text: str, *arguments: object) -> bool:
        """Log `text % arguments`, or count it if the last line is less than a period old; say which."""
        with self._lock:
            now_ns = self._now_ns()
            if self._next_ns is not None and now_ns < self._next_ns:
                self._suppressed_since += 1
                self._suppressed += 1
                return False
            self._next_ns = now_ns + self._period_ns
            unsaid, self._suppressed_since = self._suppressed_since, 0
        if unsaid:
            line = text % arguments if arguments else text
            self._logger.log(level, "%s (%d more like it were not logged)", line, unsaid)
        else:
            self._logger.log(level, text, *arguments)
        return True
