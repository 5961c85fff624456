"""What the learner tells the others, off its training thread.

A put on these channels may wait seconds for a stalled reader, so a thread of its own makes it. The
newest policy also goes to a file, for an agent that comes while no learner lives, and to the file first:
a learner that is killed in between leaves no version behind that a later one would give to other weights.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, Queue

import msgspec

from learner.diary import NAME, Diary
from rtcore import channels
from rtcore.bus import Bus
from rtcore.clock import Clock
from rtcore.files import sync, write_atomic
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Policy, WindowNotice
from rtcore.run_dir import RunDir
from rtcore.signing import NoSigner, Signer

WAIT_S = 0.2


@dataclass(frozen=True, slots=True)
class _Again:
    """A policy of an earlier learner, for whoever has not got it."""

    policy: Policy


@dataclass(frozen=True, slots=True)
class _File:
    """What a file shall hold."""

    path: Path
    data: bytes


_Item = Policy | WindowNotice | _Again | _File


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
        self._waiting: Queue[_Item] = Queue()
        self._policies = bus.publisher(channels.POLICY)
        self._windows = bus.publisher(channels.WINDOW)
        self._policy_path = run_dir.policy_path
        self.diary = Diary(run_dir.learner_dir / NAME, clock, ledger)

    def put(self, message: Policy | WindowNotice) -> None:
        """Take a message; never waits."""
        self._waiting.put(message)

    def keep(self, path: Path, data: bytes) -> None:
        """Write a file whole, in place of the one before; never waits."""
        self._waiting.put(_File(path, data))

    def republish(self, policy: Policy) -> None:
        """Send the newest policy of an earlier learner once more; never waits."""
        self._waiting.put(_Again(policy))

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

    def _send(self, item: _Item) -> None:
        match item:
            case WindowNotice():
                self._tell_diary(item)
                self._windows.put(item)
            case Policy():
                self._tell_diary(item)
                signed = self._signer.sign(item)
                self._publish(signed)
            case _Again(policy):
                self._policies.put(self._signer.sign(policy))
            case _File(path, data):
                self._write(path, lambda path: write_atomic(path, data), path.name)

    def _tell_diary(self, message: Policy | WindowNotice) -> None:
        """Before anybody can act on it: what acts is in the diary, whoever is killed."""
        self.diary.sent(message)
        self.diary.flush()

    def _publish(self, policy: Policy) -> None:
        """To the file, which outlives this process at once; to the agents; then to the disk."""
        data, what = msgspec.msgpack.encode(policy), f"policy {policy.version}"
        written = self._write(self._policy_path, lambda path: write_atomic(path, data, synced=False), what)
        self._policies.put(policy)
        if written:
            self._write(self._policy_path, sync, what)

    def _write(self, path: Path, write: Callable[[Path], None], what: str) -> bool:
        try:
            write(path)
        except OSError as error:  # a full disk, say: the policy goes to the bus all the same
            self._ledger.count(f"{path.stem}_file.errors")
            self._ledger.event(self._clock.now_ns(), "WARN", f"{what} not on disk: {error}")
            return False
        return True
