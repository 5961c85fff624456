"""What may have kept the agent from answering in time: it goes with every action, the env server judges it.

Taking and encoding it costs 3 us an action on a quiet core and 5 to 6 us on a shared one, of which 1.2 to
1.7 us are the kernel's, for the thread's wait for a core.
"""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

RECENT_NS = 100_000_000
SCHEDSTAT_BYTES = 64  # time on a core, time waiting for one in ns, number of turns: three integers


class Excuse(NamedTuple):
    """The fields of `Action` of these names, in ns."""

    swap_ns: int = 0
    collector_ns: int = 0
    starved_ns: int = 0
    resumed_ns: int = 0
    since_ns: int = 0


class Stopwatch:
    """Adds up the times that one thread at a time spends in something; another one reads."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._total_ns = 0
        self._started_ns = 0  # 0: it stands

    def start(self) -> None:
        """Begin."""
        self._started_ns = self._now_ns()

    def stop(self) -> None:
        """End."""
        started_ns, self._started_ns = self._started_ns, 0
        if started_ns:
            self._total_ns += self._now_ns() - started_ns

    def read_ns(self, now_ns: int) -> int:
        """The total until `now_ns`, with what is under way."""
        total_ns, started_ns = self._total_ns, self._started_ns
        return total_ns + max(0, now_ns - started_ns) if started_ns else total_ns


class CoreWaits:
    """How long acting threads could have run but had no core.

    The bus receives on a few threads in turn, so each keeps its open file: opening it for each answer cost
    25 us.
    """

    def __init__(self) -> None:
        self._files: dict[int, int] = {}  # by thread; -1: not Linux, or a kernel without the counters
        self._last_ns: dict[int, int] = {}
        self._read_at_ns: dict[int, int] = {}
        self._total_ns = 0

    def read_ns(self, now_ns: int) -> int:
        """The total so far, what the calling thread waited since its last call included, if that was within
        the last 100 ms: what a thread waited for while others acted is nobody's excuse.
        """
        thread = threading.get_native_id()
        if thread not in self._files:
            self._files[thread] = _open_schedstat(thread)
            self._last_ns[thread] = _waited_ns(self._files[thread])  # before it acted: of no interest
        waited_ns = _waited_ns(self._files[thread])
        if now_ns - self._read_at_ns.get(thread, 0) <= RECENT_NS:
            self._total_ns += waited_ns - self._last_ns[thread]
        self._last_ns[thread], self._read_at_ns[thread] = waited_ns, now_ns
        return self._total_ns

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            if file >= 0:
                os.close(file)
        self._files.clear()


class Evidence:
    """Collects excuses between one answer and the next.

    Without `gathered` it knows of policies alone: what the system says is none of virtual time's business.

    Args:
        now_ns: the agent's clock.
        resumed_ns: gives the instant at which the process was last continued after a stop; 0: never.
    """

    def __init__(self, now_ns: Callable[[], int], resumed_ns: Callable[[], int] = lambda: 0) -> None:
        self._now_ns = now_ns
        self.swapping = Stopwatch(now_ns)  # the acting thread puts a policy in place
        self.checking = Stopwatch(now_ns)  # another one prepares it, and they share the interpreter
        self._collecting = Stopwatch(now_ns)
        self._resumed_ns = resumed_ns
        self._since_ns = 0
        self._gathered = False
        self._waits = CoreWaits()
        self._starved_ns = self._collected_ns = self._checked_ns = self._swapped_ns = 0  # at the last answer

    @contextmanager
    def gathered(self) -> Iterator[None]:
        """Watch the collector, and the acting thread's waits for a core, inside the block."""
        gc.callbacks.append(self._on_collector)
        self._gathered = True
        try:
            yield
        finally:
            self._gathered = False
            gc.callbacks.remove(self._on_collector)
            self._waits.close()

    def excuse(self, received_ns: int, *, settle: bool = True) -> Excuse:
        """Everything since the last call that settled. For the acting thread, right before it takes the
        stamp and sends: so what the excuse says lies before that.

        Args:
            received_ns: when the observation came that is answered now.
            settle: the next call begins here; a rehearsal leaves everything to the next answer.
        """
        now_ns = self._now_ns()
        if not self._since_ns:
            self._since_ns = received_ns
        swapped_ns, checked_ns = self.swapping.read_ns(now_ns), self.checking.read_ns(now_ns)
        collected_ns = self._collecting.read_ns(now_ns)
        starved_ns = self._waits.read_ns(now_ns) if self._gathered else 0
        excuse = Excuse(
            max(0, swapped_ns - self._swapped_ns + checked_ns - self._checked_ns),
            max(0, collected_ns - self._collected_ns),
            max(0, starved_ns - self._starved_ns),
            self._resumed_ns(),
            self._since_ns,
        )
        if settle:
            self._swapped_ns, self._checked_ns = swapped_ns, checked_ns
            self._collected_ns, self._starved_ns = collected_ns, starved_ns
        return excuse

    def _on_collector(self, phase: str, info: dict[str, int]) -> None:
        del info
        if phase == "start":
            self._collecting.start()
        else:
            self._collecting.stop()


def _open_schedstat(thread: int) -> int:
    try:
        return os.open(f"/proc/self/task/{thread}/schedstat", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return -1


def _waited_ns(schedstat: int) -> int:
    """The second of the counters in an open schedstat file; 0 where there is none (-1)."""
    if schedstat < 0:
        return 0
    try:
        return int(os.pread(schedstat, SCHEDSTAT_BYTES, 0).split()[1])
    except (OSError, IndexError, ValueError):
        return 0
