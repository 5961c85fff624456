"""Who is stuck, by his own word: each process's stats say when its loop last turned. Pure.

A process that was stopped, hangs in a lock or waits for a disk says nothing new, whatever its threads say.
Ages are counted on the launcher's own waking time: what nobody could have heard is held against nobody. Nor
is a silence for a good reason: the process waited for a core.
"""

from __future__ import annotations

from dataclasses import dataclass

from rtcore import channels
from rtcore.cast import role_of
from rtcore.messages import Stats

START_NS = 60_000_000_000  # from a start to the first turn: learning's libraries, a busy machine
# The launcher looks 20 times a second. A longer pause between two looks was its own: it was stopped, or the
# machine was, and so may have been the others.
LONGEST_LOOK_NS = 500_000_000
# A thread that hangs, too, is woken now and then and waits for a moment. Of a silence for want of a core more
# than this share of the limit was waiting: half of it, if all since somebody looked was.
STARVED_SHARE = 0.25
# All processes speak four times a second each. Hearing nobody for so long, the launcher is the deaf one.
DEAF_NS = 1_000_000_000
# A silence of so many times the limit is a hang whatever excuses it: one thread may wait for a core for as
# long as the machine is busy, while another one hangs.
PATIENCE = 10


@dataclass
class _Life:
    """One life of a process.

    Attributes:
        earlier: the greatest incarnation of its earlier lives, whose last words may still come.
        turned_ns: the launcher's waking time when it last heard of a turn, or when the life began.
        beat_ns: the newest turn, as the process stamped it; 0: none yet.
        excused_ns: of the time since that turn, what is not held against it.
        starved: that was told, in this silence.
    """

    earlier: int
    turned_ns: int
    beat_ns: int = 0
    excused_ns: int = 0
    starved: bool = False


class Vitals:
    """Watches over processes between `started` and `gone`."""

    def __init__(self, stuck_s: float) -> None:
        self._stuck_ns = round(stuck_s * 1e9)
        self._lives: dict[str, _Life] = {}
        self._newest: dict[str, int] = {}  # incarnation of each process
        self._awake_ns = 0
        self._passed_ns = 0  # of it, with the last look
        self._looked_ns: int | None = None
        self._heard_ns: int | None = None  # when anybody was heard

    def started(self, process: str) -> None:
        """A life begins."""
        self._lives[process] = _Life(self._newest.get(process, -1), self._awake_ns)

    def gone(self, process: str) -> None:
        """It ended; nothing is expected of it."""
        self._lives.pop(process, None)

    def heard(self, stats: Stats, received_ns: int) -> None:
        """Take in a message, of whatever process and life."""
        if role_of(stats.process) not in channels.PROCESSES:
            return
        self._heard_ns = received_ns
        self._newest[stats.process] = max(stats.incarnation, self._newest.get(stats.process, -1))
        life = self._lives.get(stats.process)
        if life is not None and stats.incarnation > life.earlier and stats.beat_ns > life.beat_ns:
            life.beat_ns, life.turned_ns = stats.beat_ns, self._awake_ns
            life.excused_ns, life.starved = 0, False

    def look(self, now_ns: int) -> None:
        """Time has passed. To be called many times a second, after what has come was taken in."""
        since_ns = now_ns - (now_ns if self._looked_ns is None else self._looked_ns)
        self._looked_ns = now_ns
        deaf = self._heard_ns is None or now_ns - self._heard_ns > DEAF_NS
        self._passed_ns = 0 if deaf else min(since_ns, LONGEST_LOOK_NS)
        self._awake_ns += self._passed_ns

    def silent(self) -> list[str]:
        """Who should be looked at: silent for more than half of what it may be."""
        return [name for name, life in self._lives.items() if self.silent_ns(name) > self._limit_ns(life) / 2]

    def excuse(self, process: str, ns: int) -> None:
        """So much of the time that passed with the last look is not held against it."""
        self._lives[process].excused_ns += min(ns, self._passed_ns)

    def stuck(self) -> list[str]:
        """Whose loop has not turned for longer than `stuck_s`, or not at all in 60 s from the start, without
        what is excused; or for ten times as long.
        """
        return [
            name
            for name, life in self._lives.items()
            if (silent_ns := self.silent_ns(name)) - life.excused_ns > (limit_ns := self._limit_ns(life))
            or silent_ns > PATIENCE * limit_ns
        ]

    def starving(self) -> list[str]:
        """Who would be stuck but for what is excused, which is no small part; each once in a silence."""
        stuck = self.stuck()
        found = [
            name
            for name, life in self._lives.items()
            if not life.starved
            and name not in stuck
            and self.silent_ns(name) > (limit_ns := self._limit_ns(life))
            and life.excused_ns > STARVED_SHARE * limit_ns
        ]
        for name in found:
            self._lives[name].starved = True
        return found

    def silent_ns(self, process: str) -> int:
        """For how long, in waking time, no turn of its loop was heard of."""
        return self._awake_ns - self._lives[process].turned_ns

    def _limit_ns(self, life: _Life) -> int:
        return self._stuck_ns if life.beat_ns else max(START_NS, self._stuck_ns)
