"""Time as a parameter: the host's monotonic clock, or a virtual one that a test or `sim` moves."""

from __future__ import annotations

from typing import Protocol


class Clock(Protocol):
    """A source of integer nanoseconds that can be waited on."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary fixed instant; never goes back."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at or after `deadline_ns`; at once if it has passed."""

    def rest_until_ns(self, deadline_ns: int) -> None:
        """Like `sleep_until_ns`, for what need not be exact: leaves the core to others until the end."""


class VirtualClock:
    """A clock that moves only when told to, or when somebody sleeps on it.

    Work takes no time on it unless `advance_ns` says so, so timing tests are exact.
    """

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """The virtual instant."""
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Move to `deadline_ns`, never backwards."""
        self._now_ns = max(self._now_ns, deadline_ns)

    def rest_until_ns(self, deadline_ns: int) -> None:
        """The same as `sleep_until_ns`."""
        self.sleep_until_ns(deadline_ns)

    def advance_ns(self, duration_ns: int) -> None:
        """Let `duration_ns` pass, as work would."""
        if duration_ns < 0:
            raise ValueError(f"duration_ns = {duration_ns}: time does not go back")
        self._now_ns += duration_ns
