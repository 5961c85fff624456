"""What the launcher knows of a running system: the newest ledgers, rates, and what was said. No I/O."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterable

import msgspec

from launcher.restarts import Happening
from launcher.summary import StatsByProcess
from launcher.totals import Totals, add_up, together
from rtcore import channels
from rtcore.cast import index_of, role_of
from rtcore.health import Health, health
from rtcore.messages import EpisodeReturn, Event, Stats, WindowNotice
from rtcore.tally import raised

RATE_SPAN_NS = 2_000_000_000  # long enough that four messages a second make a steady figure
EVENTS_KEPT = 200
MAX_LIVES = 1000  # of all processes: more are a stranger's; and so many histograms can be added up
RETURNS_SHOWN = 60


class _Incarnation:
    """One life of one process.

    A message has the newest 64 returns, and all that were ever seen are kept: number and value of each, 16
    bytes. A screen reads four times a second and must not take the longer the more there are.
    """

    def __init__(self, newest: Stats) -> None:
        self.newest = newest
        self._episodes, self._values = array("q"), array("d")  # in the order of the episodes
        self._best = -math.inf
        self.learn(newest.returns)

    def learn(self, returns: Iterable[EpisodeReturn]) -> None:
        """Take in returns; those that are known already change nothing."""
        for one in returns:
            at = bisect_left(self._episodes, one.episode)
            if at == len(self._episodes) or self._episodes[at] != one.episode:
                self._episodes.insert(at, one.episode)
                self._values.insert(at, one.value)
                self._best = max(self._best, one.value)

    def whole(self) -> Stats:
        """The newest ledger with all returns that were ever seen."""
        return msgspec.structs.replace(self.newest, returns=self._listed(0))

    def shown(self) -> Stats:
        """The newest ledger with the returns that a screen needs: the newest 60, before them the best."""
        first = max(0, len(self._episodes) - RETURNS_SHOWN)
        returns = self._listed(first)
        if first:
            returns.insert(0, _episode(self._episodes[first - 1], self._best))
        return msgspec.structs.replace(self.newest, returns=returns)

    def _listed(self, first: int) -> list[EpisodeReturn]:
        pairs = zip(self._episodes[first:], self._values[first:], strict=True)
        return [_episode(number, value) for number, value in pairs]


def _episode(number: int, value: float) -> EpisodeReturn:
    """A return without its time and length, which nobody asks the launcher for."""
    return EpisodeReturn(episode=number, at_ns=0, value=value, length=0)


class Watch:
    """Folds Stats messages, in whatever order they come, and keeps what the launcher did itself.

    Attributes:
        events: what the processes said, newest last.
        happenings: all deaths and restarts, and silences for want of a core.
        restarts: how often each process was started again.
        down: processes between two lives, or given up.
        refused: messages of lives beyond what there can be.
    """

    def __init__(self, hz: float) -> None:
        self._hz = hz
        self.refused = 0
        self._lives: dict[tuple[str, int], _Incarnation] = {}
        self._seen_ns: dict[str, int] = {}
        self._told_ns: dict[str, int] = {}  # stamp of each process's newest event
        self._recent: dict[str, deque[Stats]] = {}
        self.events: deque[tuple[str, Event]] = deque(maxlen=EVENTS_KEPT)
        self.happenings: list[Happening] = []
        self.restarts: Counter[str] = Counter()
        self.down: set[str] = set()

    def feed(self, stats: Stats, received_ns: int) -> None:
        """Take in one message, received at `received_ns` on this process's clock."""
        key = (stats.process, stats.incarnation)
        if key not in self._lives and len(self._lives) >= MAX_LIVES:
            self.refused += 1
            return
        life = self._lives.setdefault(key, _Incarnation(stats))
        if stats.seq >= life.newest.seq:
            life.newest = stats
        life.learn(stats.returns)
        self.events.extend(self._news(stats))  # they come repeatedly, oldest first
        self._seen_ns[stats.process] = received_ns
        recent = self._recent.setdefault(stats.process, deque())
        if recent and recent[-1].incarnation != stats.incarnation:
            recent.clear()
        recent.append(stats)
        while len(recent) > 2 and stats.at_ns - recent[1].at_ns >= RATE_SPAN_NS:
            recent.popleft()

    def happened(self, happening: Happening) -> None:
        """Take note of a death or a restart. Nothing that an earlier life said tells how the next one is."""
        self.happenings.append(happening)
        if happening.what == "starved":  # it lives
            return
        process = happening.process
        self._seen_ns.pop(process, None)
        self._recent.pop(process, None)
        if happening.what == "restarted":
            self.restarts[process] += 1
            self.down.discard(process)
        else:
            self.down.add(process)

    def _news(self, stats: Stats) -> list[tuple[str, Event]]:
        told_ns = self._told_ns.get(stats.process, -1)
        fresh = [(stats.process, event) for event in stats.events if event.at_ns > told_ns]
        if fresh:
            self._told_ns[stats.process] = fresh[-1][1].at_ns
        return fresh

    def feed_final(self, stats: Iterable[Stats]) -> None:
        """Take in what the processes left behind: nothing is missing from last words, nor from the counters
        of a life that was killed; of its other figures there are those that were heard.
        """
        for one in stats:
            heard = self._lives.get((one.process, one.incarnation))
            if heard is not None and not one.final:
                counters = raised(heard.newest.counters, one.counters)
                heard.newest = msgspec.structs.replace(heard.newest, counters=counters)
                continue
            self._lives[(one.process, one.incarnation)] = _Incarnation(one)

    def stats(self) -> StatsByProcess:
        """The newest ledger of each incarnation, for the summary."""
        found: dict[str, list[Stats]] = {}
        for (process, _), life in sorted(self._lives.items()):
            found.setdefault(process, []).append(life.whole())
        return found

    def totals(self, name: str) -> Totals:
        """The ledgers of a process, or of all processes of a role, added up; empty before a first message. Of
        each life's returns there are the newest 60 and, before them, the best.
        """
        lives: dict[str, list[Stats]] = {}
        for (process, _), life in self._lives.items():
            if name in (process, role_of(process)):
                lives.setdefault(process, []).append(life.shown())
        in_order = sorted(lives, key=lambda process: index_of(process) or 0)
        return together(add_up(lives[process]) for process in in_order)

    def rate(self, name: str, counter: str) -> float | None:
        """A counter's rise per second over the last two seconds, of a process or of all of a role that have
        one; None before two messages came. Of a role, who has ended counts no more while others go on.
        """
        processes = [process for process in self._recent if name in (process, role_of(process))]
        going_on = [process for process in processes if not self.ended(process)] or processes
        rates = [rate for process in going_on if (rate := self._rate(process, counter)) is not None]
        return sum(rates) if rates else None

    def _rate(self, process: str, counter: str) -> float | None:
        recent = self._recent.get(process)
        if recent is None or len(recent) < 2:
            return None
        first, last = recent[0], recent[-1]
        span_s = (last.at_ns - first.at_ns) / 1e9
        if span_s <= 0:
            return None
        return (last.counters.get(counter, 0) - first.counters.get(counter, 0)) / span_s

    def heard(self, process: str) -> bool:
        """Whether anything came from it in this life."""
        return process in self._seen_ns

    def health(self, process: str, now_ns: int) -> Health:
        """By the stats channel's row: how long ago the process last spoke."""
        return health(channels.STATS, self._hz, self._seen_ns.get(process), now_ns)

    def ended(self, process: str) -> bool:
        """Whether its newest incarnation said that it ended in order."""
        newest = self._newest(process)
        return newest is not None and newest.final

    def phase(self) -> WindowNotice | None:
        """The phase that the learner entered last, in whichever life."""
        lives = [life.newest for (name, _), life in self._lives.items() if name == channels.LEARNER]
        told = [stats for stats in lives if stats.windows]
        return max(told, key=lambda stats: stats.incarnation).windows[-1] if told else None

    def _newest(self, process: str) -> Stats | None:
        lives = [life.newest for (name, _), life in self._lives.items() if name == process]
        return max(lives, key=lambda stats: stats.incarnation, default=None)
