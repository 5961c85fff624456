"""Run delay: how long a process was ready to run and got no core, as the kernel counts it (schedstat)."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
RUNNABLE = "R"


@dataclass(frozen=True, slots=True)
class Thread:
    """What the kernel knows of a thread.

    Attributes:
        ran_ns: that it was on a core.
        waited_ns: that it waited for one. A wait is entered at its end.
        runnable: it is on a core or waits for one.
    """

    ran_ns: int
    waited_ns: int
    runnable: bool


def grown_ns(before: Thread, now: Thread, elapsed_ns: int) -> int:
    """How long a thread waited in the last `elapsed_ns`."""
    # Ready at both ends and not on a core in between: a wait that is not over. 0 is what a kernel says that
    # does not count.
    if before.runnable and now.runnable and 0 < now.ran_ns == before.ran_ns:
        return elapsed_ns
    return min(now.waited_ns - before.waited_ns, elapsed_ns)


class RunDelay:
    """The run delay of a process from the first call of `grown_ns` on. That of any thread will do: the loop
    may wait for each of them, and what it says goes out by another one.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._before: dict[str, Thread] = {}
        self._looked_ns: int | None = None

    def grown_ns(self, now_ns: int) -> int:
        """The longest that one of its threads waited since the call before; 0 if the system does not tell."""
        threads = read(self._pid)
        elapsed_ns = 0 if self._looked_ns is None else now_ns - self._looked_ns
        waits = [
            grown_ns(self._before[number], thread, elapsed_ns)
            for number, thread in threads.items()
            if number in self._before
        ]
        self._before, self._looked_ns = threads, now_ns
        return max(waits, default=0)


def read(pid: int) -> dict[str, Thread]:
    """The threads of a process by number; none if it has gone, or where the system does not tell."""
    found: dict[str, Thread] = {}
    with suppress(OSError):
        for task in (PROC / str(pid) / "task").iterdir():
            with suppress(OSError):  # a thread that ends meanwhile
                ran, waited, _ = (task / "schedstat").read_text().split()
                state = (task / "stat").read_text().rpartition(")")[2].split()[0]
                found[task.name] = Thread(int(ran), int(waited), state == RUNNABLE)
    return found
