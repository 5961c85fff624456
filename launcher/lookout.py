"""What the launcher does 20 times a second while a run goes on: listen, tell, draw."""

from __future__ import annotations

import time
from collections.abc import Collection

from launcher.herald import Herald
from launcher.restarts import Happening
from launcher.screen import Screen
from launcher.viewer import Viewer
from launcher.vitals import Vitals
from launcher.watch import Watch
from rtcore import channels
from rtcore.bus import Bus, QueueReader
from rtcore.cast import role_of
from rtcore.clock import Clock
from rtcore.messages import Stats


def by_role(processes: Collection[str]) -> list[str]:
    """Processes in connect order, for people: those of a fleet are counted, as `3 env_server`."""
    found = []
    for role in channels.PROCESSES:
        names = [name for name in processes if role_of(name) == role]
        found += names if len(names) < 2 else [f"{len(names)} {role}"]
    return found


class Lookout:
    """Passes on what the processes say, and what happens to them, to whoever shows, judges or records it.

    Attributes:
        vitals: kept informed.
    """

    def __init__(self, watch: Watch, vitals: Vitals, screen: Screen, viewer: Viewer, clock: Clock) -> None:
        self.vitals = vitals
        self._watch = watch
        self._screen = screen
        self._viewer = viewer
        self._clock = clock
        self._herald: Herald | None = None
        self._stats: QueueReader[Stats] | None = None

    def join(self, bus: Bus) -> None:
        """Listen and speak on the bus from now on."""
        self._herald = Herald(bus, self._clock, time.time_ns())
        self._stats = bus.queue(channels.STATS, "*")

    def happened(self, happening: Happening) -> None:
        """Tell of a death or a restart everywhere."""
        self._watch.happened(happening)
        self._screen.say(f"{time.strftime('%H:%M:%S')}  {happening.text}")
        if self._herald is not None:
            self._herald.tell(happening)

    def look(self, waiting_for: frozenset[str]) -> None:
        """One turn; `waiting_for` are the processes that are to end."""
        if self._herald is not None:
            self._herald.pulse()
        for received in [] if self._stats is None else self._stats.drain():
            self._watch.feed(received.message, received.received_ns)
            self.vitals.heard(received.message, received.received_ns)
        if self._viewer.due and self._watch.heard(channels.RECORDER):
            self._open_view()
        if waiting_for:
            self._screen.note = "ending: " + ", ".join(by_role(waiting_for))
        self._screen.update()

    def _open_view(self) -> None:
        """Nobody's run ends for want of a view."""
        try:
            self._viewer.open()
        except OSError as error:
            self._screen.say(f"no view: {error}")
        else:
            self._screen.say(f"view {self._viewer.address}")
