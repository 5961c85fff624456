"""What the learner tells the others, off its training thread.

A put on these channels may wait seconds for a stalled reader, so a thread of its own makes it. The
newest policy also goes to a file, for an agent that comes while no learner lives.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue

import msgspec

from learner.diary import NAME, Diary
from rtcore import channels
from rtcore.bus import Bus
from rtcore.clock import Clock
from rtcore.files import write_atomic
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Policy, WindowNotice
from rtcore.run_dir import RunDir
from rtcore.signing import NoSigner, Signer

WAIT_S = 0.2


class Outbox:
    """Policies and window notices on their way out, in order.

    Attributes:
        diary: of what goes out, and of what others tell it; written here.
    """

    def __init__(
        self, bus: Bus, run_dir: RunDir, clock: Clock, ledger: Ledger, signer: Signer | None = None
    ) -> None:
        """`signer` signs what is published; None: nobody does."""
        self._signer = signer or NoSigner()
        self._clock = clock
        self._ledger = ledger
        self._waiting: SimpleQueue[Policy | WindowNotice | tuple[Path, bytes]] = SimpleQueue()
        self._policies = bus.publisher(channels.POLICY)
        self._windows = bus.publisher(channels.WINDOW)
        self._policy_path = run_dir.policy_path
        self.diary = Diary(run_dir.learner_dir / NAME, clock, ledger)

    def put(self, message: Policy | WindowNotice) -> None:
        """Take a message; never waits."""
        self._waiting.put(message)

    def keep(self, path: Path, data: bytes) -> None:
        """Write a file whole, in place of the one before; never waits."""
        self._waiting.put((path, data))

    def flush(self) -> None:
        """Send all that waits."""
        while True:
            try:
                self._send(self._waiting.get_nowait())
            except Empty:
                break
        self.diary.flush()

    def run(self, stop: Stop) -> None:
        """Send until stopped, then what is left."""
        while not stop.is_set():
            with suppress(Empty):
                self._send(self._waiting.get(timeout=WAIT_S))
            self.diary.flush()
        self.flush()

    def _send(self, message: Policy | WindowNotice | tuple[Path, bytes]) -> None:
        if isinstance(message, WindowNotice):
            self._windows.put(message)
            self.diary.sent(message)
        elif isinstance(message, Policy):
            message = self._signer.sign(message)
            self._policies.put(message)
            self.diary.sent(message)
            self._write(self._policy_path, msgspec.msgpack.encode(message), f"policy {message.version}")
        else:
            self._write(*message, message[0].name)

    def _write(self, path: Path, data: bytes, what: str) -> None:
        try:
            write_atomic(path, data)
        except OSError as error:  # a full disk, say: the policy is on the bus all the same
            self._ledger.count(f"{path.stem}_file.errors")
            self._ledger.event(self._clock.now_ns(), "WARN", f"{what} not on disk: {error}")
