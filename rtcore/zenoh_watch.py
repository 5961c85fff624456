"""Counts what Zenoh refuses on secured links, by reading what Zenoh writes to standard output."""

from __future__ import annotations

import fcntl
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from rtcore import realtime
from rtcore.clock import Clock
from rtcore.ledger import Ledger
from rtcore.zenoh_refusals import Refusal, Refusals

STDOUT = 1
POLL_S = 0.1  # not at every line: a thread that wakes takes the interpreter from the one that acts
PIPE_BYTES = 1 << 20  # 3 s of a system at 500 Hz, at 4 lines of 150 bytes a tick
TOLD_NS = (
    10_000_000_000  # each refusal is told once in so long, and of all of them MOST_TOLD; all are counted
)
MOST_TOLD = 10


class Watch:
    """Books refusals: counts `link.refused` (links), `link.denied` (messages), tells some as events."""

    def __init__(self, ledger: Ledger, clock: Clock) -> None:
        self._ledger = ledger
        self._clock = clock
        self._refusals = Refusals()
        self._told_ns: dict[str, int] = {}

    def feed(self, data: bytes) -> bytes:
        """Take in output; returns what was not Zenoh's."""
        others = b""
        for found in self._refusals.feed(data):
            if isinstance(found, Refusal):
                self._book(found)
            else:
                others += found
        return others

    def _book(self, refusal: Refusal) -> None:
        self._ledger.count("link.refused" if refusal.kind == "link" else "link.denied")
        now_ns = self._clock.now_ns()
        if now_ns - self._told_ns.get(refusal.text, now_ns - TOLD_NS) >= TOLD_NS:
            self._told_ns = {text: at for text, at in self._told_ns.items() if now_ns - at < TOLD_NS}
            if len(self._told_ns) < MOST_TOLD:
                self._told_ns[refusal.text] = now_ns
                self._ledger.event(now_ns, "WARN", f"{refusal.kind} refused: {refusal.text}")


@contextmanager
def watched(ledger: Ledger, clock: Clock) -> Iterator[None]:
    """Read standard output for as long as the block runs; what others write to it goes through.

    Enter it before the session is opened. Zenoh never waits for the reader: when the pipe is full, lines are
    lost.
    """
    source, sink = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
    with suppress(OSError):  # more than this user may have: then the default of 64 KiB
        fcntl.fcntl(sink, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    sys.stdout.flush()
    original = os.dup(STDOUT)
    os.dup2(sink, STDOUT)
    os.close(sink)
    ended = threading.Event()
    thread = threading.Thread(
        target=_read, args=(source, original, Watch(ledger, clock), ended), name="refusals", daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(original, STDOUT)
        ended.set()
        thread.join()
        os.close(source)
        os.close(original)


def _read(source: int, original: int, watch: Watch, ended: threading.Event) -> None:
    realtime.step_back()
    last = False
    while not last:
        last = ended.wait(POLL_S)
        with suppress(BlockingIOError):  # nothing more for now
            while data := os.read(source, PIPE_BYTES):
                others = watch.feed(data)
                with suppress(OSError):  # nobody reads it any more
                    os.write(original, others)
