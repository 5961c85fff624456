"""What the learner tells the others, off its training thread.

A put on these channels may wait seconds for a stalled reader, so a thread of its own makes it. The
newest policy also goes to a file, for an agent that comes while no learner lives.
"""

from __future__ import annotations

from queue import Empty, SimpleQueue

import msgspec

from rtcore import channels
from rtcore.bus import Bus
from rtcore.clock import Clock
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Policy, WindowNotice
from rtcore.run_dir import RunDir, write_atomic

WAIT_S = 0.2


class Outbox:
    """Policies and window notices on their way out, in order."""

    def __init__(self, bus: Bus, run_dir: RunDir, clock: Clock, ledger: Ledger) -> None:
        self._clock = clock
        self._ledger = ledger
        self._waiting: SimpleQueue[Policy | WindowNotice] = SimpleQueue()
        self._policies = bus.publisher(channels.POLICY)
        self._windows = bus.publisher(channels.WINDOW)
        self._policy_path = run_dir.policy_path

    def put(self, message: Policy | WindowNotice) -> None:
        """Take a message; never waits."""
        self._waiting.put(message)

    def flush(self) -> None:
        """Send all that waits."""
        while True:
            try:
                self._send(self._waiting.get_nowait())
            except Empty:
                return

    def run(self, stop: Stop) -> None:
        """Send until stopped, then what is left."""
        while not stop.is_set():
            try:
                self._send(self._waiting.get(timeout=WAIT_S))
            except Empty:
                continue
        self.flush()

    def _send(self, message: Policy | WindowNotice) -> None:
        if isinstance(message, WindowNotice):
            self._windows.put(message)
            return
        self._policies.put(message)
        try:
            write_atomic(self._policy_path, msgspec.msgpack.encode(message))
        except OSError as error:  # a full disk, say: the policy is on the bus all the same
            self._ledger.count("policy_file.errors")
            self._ledger.event(self._clock.now_ns(), "WARN", f"policy {message.version} not on disk: {error}")
