"""Puts the messages of each lossless publisher in order when a reader meets it in mid-stream.

Zenoh's own history (1.10) covers publishers that are there when a reader is declared. One that comes
later, as after a restart, may deliver its first live message before its history; Zenoh then throws
the history away (measured: the first 24 of 150 messages, each time). And a message that arrives damaged
counts as delivered for Zenoh. So whenever numbers are missing, what comes after them is held back until they
have been asked for, once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")

HELD_LIMIT = 4096  # live messages held back at most; twice a publisher's cache


@dataclass(slots=True)
class _Source(Generic[T]):
    next: int = 0  # the number that comes next; everything below was delivered or is lost
    fetching: bool = False  # what comes is held until the missing numbers are there
    held: dict[int, T] = field(default_factory=dict)


class SourceOrder(Generic[T]):
    """Delivers each source's numbered items once, in rising order. Usable from any thread."""

    def __init__(self, deliver: Callable[[T], None]) -> None:
        self._deliver = deliver
        self._lock = threading.Lock()
        self._sources: dict[str, _Source[T]] = {}

    def live(self, source: str, number: int, item: T) -> int | None:
        """Take a live item. A result means: fetch this source's numbers from the result to `number`, hand
        them to `history`, and call `fetched` when no more will come.
        """
        with self._lock:
            state = self._sources.setdefault(source, _Source())
            if state.fetching:
                state.held.setdefault(number, item)
                if len(state.held) >= HELD_LIMIT:
                    self._release(state)
            elif number == state.next:
                state.next = number + 1
                self._deliver(item)
            elif number > state.next:
                state.fetching = True
                state.held[number] = item
                return state.next
            return None

    def history(self, source: str, number: int, item: T) -> None:
        """Take a fetched item; one that comes too late is ignored."""
        with self._lock:
            state = self._sources[source]
            if state.fetching:
                state.held.setdefault(number, item)

    def fetched(self, source: str) -> None:
        """The fetch has ended, with or without success: deliver what is held."""
        with self._lock:
            self._release(self._sources[source])

    def _release(self, state: _Source[T]) -> None:
        held, state.held, state.fetching = state.held, {}, False
        for number in sorted(held):
            if number >= state.next:
                state.next = number + 1
                self._deliver(held[number])
