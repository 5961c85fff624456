"""Where received bytes wait for a service: what both buses' readers are made of.

A bus only puts bytes and their arrival time here, on whatever thread it receives on. Decoding happens
on the reader's own thread, so a slow or bad message costs the transport nothing; but for an `Attendant`.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, Protocol

from rtcore.bus import Received
from rtcore.channels import MessageT
from rtcore.codec import Codec


class Bell(Protocol):
    """Lets a reader sleep until something has come."""

    def ring(self) -> None:
        """Something has come. From any thread; never waits."""

    def wait(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` > 0 seconds for a ring since the last wait; say whether there was one."""


class ThreadBell:
    """A bell on a bare lock: it wakes in one system call, and signal handlers run during a wait."""

    def __init__(self) -> None:
        self._unrung = threading.Lock()
        self._unrung.acquire()

    def ring(self) -> None:
        """Release the waiter, or the next one."""
        if self._unrung.locked():
            try:
                self._unrung.release()
            except RuntimeError:  # another thread rang in between
                return

    def wait(self, timeout_s: float) -> bool:
        """Wait for a ring."""
        return self._unrung.acquire(timeout=timeout_s)


class Inbox(Protocol):
    """Takes what a bus receives."""

    def offer(self, payload: bytes, received_ns: int, name: str = "") -> None:
        """Keep the bytes that arrived at `received_ns`. From any thread; never waits. `name`: the one in the
        key, where the reader reads several."""


class LatestInbox(Generic[MessageT]):
    """The newest message only; see `rtcore.bus.LatestReader`."""

    def __init__(self, codec: Codec[MessageT], bell: Bell, now_ns: Callable[[], int]) -> None:
        self._codec = codec
        self._bell = bell
        self._now_ns = now_ns
        self._slot: deque[tuple[bytes, int, str]] = deque(maxlen=1)  # append and pop are atomic

    def offer(self, payload: bytes, received_ns: int, name: str = "") -> None:
        """Replace what is there."""
        self._slot.append((payload, received_ns, name))
        self._bell.ring()

    def take(self) -> Received[MessageT] | None:
        """The newest message if it was not taken before and is valid, else None."""
        try:
            payload, received_ns, name = self._slot.pop()
        except IndexError:
            return None
        message = self._codec.decode(payload, name)
        return None if message is None else Received(message, received_ns)

    def wait(self, timeout_s: float) -> Received[MessageT] | None:
        """Like `take`, but waits for a valid message; an invalid one does not end the wait."""
        deadline_ns = self._now_ns() + round(timeout_s * 1e9)
        while (received := self.take()) is None:
            remaining_ns = deadline_ns - self._now_ns()
            if remaining_ns <= 0 or not self._bell.wait(remaining_ns / 1e9):
                return self.take()
        return received


class Attendant(Generic[MessageT]):
    """No box at all: each valid message is answered on the thread that received it; see
    `rtcore.bus.Bus.attend`."""

    def __init__(self, codec: Codec[MessageT], answer: Callable[[Received[MessageT]], None]) -> None:
        self._codec = codec
        self._answer = answer

    def offer(self, payload: bytes, received_ns: int, name: str = "") -> None:
        """Decode and answer."""
        message = self._codec.decode(payload, name)
        if message is not None:
            self._answer(Received(message, received_ns))


class QueueInbox(Generic[MessageT]):
    """Every message in order, up to a capacity; see `rtcore.bus.QueueReader`."""

    def __init__(self, codec: Codec[MessageT], capacity: int, bell: Bell, now_ns: Callable[[], int]) -> None:
        if capacity < 1:
            raise ValueError(f"capacity = {capacity}: must be at least 1")
        self._codec = codec
        self._bell = bell
        self._now_ns = now_ns
        self._lock = threading.Lock()  # between receiving threads, so that the count is exact
        self._items: deque[tuple[bytes, int, str]] = deque(maxlen=capacity)
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Messages lost because the queue was full."""
        return self._dropped

    def offer(self, payload: bytes, received_ns: int, name: str = "") -> None:
        """Append; a full queue loses its oldest, which counts as refused."""
        with self._lock:
            full = len(self._items) == self._items.maxlen
            self._dropped += full
            self._items.append((payload, received_ns, name))
        if full:
            self._codec.reject("the queue is full: the oldest is lost")
        self._bell.ring()

    def drain(self) -> list[Received[MessageT]]:
        """All waiting messages that are valid, oldest first."""
        with self._lock:
            items = list(self._items)
            self._items.clear()
        drained = []
        for payload, received_ns, name in items:
            message = self._codec.decode(payload, name)
            if message is not None:
                drained.append(Received(message, received_ns))
        return drained

    def wait(self, timeout_s: float) -> bool:
        """Wait until something is there; say whether it is."""
        deadline_ns = self._now_ns() + round(timeout_s * 1e9)
        while not self._items:
            remaining_ns = deadline_ns - self._now_ns()
            if remaining_ns <= 0 or not self._bell.wait(remaining_ns / 1e9):
                break
        return bool(self._items)
