"""What a process has done so far: counters, gauges, histograms and events, as one cumulative message."""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Mapping, Sequence

from msgspec.structs import replace

from rtcore.histogram import Histogram
from rtcore.messages import EpisodeReturn, Event, Level, Stats, WindowNotice
from rtcore.tally import Tally

EVENTS_DROPPED = "events.dropped"
# Bounds that keep a running process's message below the channel's 1 MiB: 256 events of 500 characters
# are 130 kB, 4096 window notices 160 kB. The final message has all returns and windows.
MAX_EVENTS = 256
MAX_TEXT = 500
REPEAT_NS = 10_000_000_000  # the launcher, the first reader, and the recorder, the last, start 3 s apart
RECENT_RETURNS = 64
RECENT_WINDOWS = 4096
MOST_RETURNS = 20_000  # of 25 bytes: half of the largest message on the channel of stats

LOG_LEVELS: dict[Level, int] = {
    "DEBUG": logging.DEBUG,
    "INFO": logging.INFO,
    "WARN": logging.WARNING,
    "ERROR": logging.ERROR,
}


class Ledger:
    """One process's books. Thread-safe, except that a histogram has one thread that records in it.

    Counters only rise; `stats` is a snapshot of everything since the start, so a lost message loses
    nothing but, after 10 s, its events, and those are in the process's log as well. A `tally` has every
    counter at every instant, for the case that the process is killed before its next message.
    """

    def __init__(self, process: str, incarnation: int, tally: Tally | None = None) -> None:
        self._process = process
        self._incarnation = incarnation
        self._tally = tally
        self._beat_ns = 0
        self._logger = logging.getLogger(process)
        self._lock = threading.Lock()
        self._seq = 0
        self._counters: Counter[str] = Counter()
        self._gauges: dict[str, float] = {}
        self._histograms: dict[str, Histogram] = {}
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self._unsent = 0  # how many of them, the newest, were in no snapshot yet
        self._returns: list[EpisodeReturn] = []
        self._windows: list[WindowNotice] = []

    def count(self, name: str, n: int = 1) -> None:
        """Add `n` >= 0 to a counter, which starts at 0: 0.26 us, with a tally 0.34."""
        if n < 0:
            raise ValueError(f"{name}: n = {n}: a counter does not fall")
        with self._lock:
            value = self._counters[name] = self._counters[name] + n
            if self._tally is not None:
                self._tally.set(name, value)

    def count_together(self, *names: str, values: Mapping[str, int] | None = None) -> None:
        """Add one to each, and take over `values` as `set_counter` does, of at most 16 counters in all: no
        snapshot, and no tally, has only some of it.
        """
        with self._lock:
            group = {name: self._counters[name] + 1 for name in names}
            if values:
                for name, value in values.items():
                    self._check_rises(name, value)
                group.update(values)
            for name, value in group.items():  # a Counter's own update adds
                self._counters[name] = value
            if self._tally is not None:
                self._tally.set_together(group)

    def set_counter(self, name: str, value: int) -> None:
        """Take over a count that is kept elsewhere, such as the bus's; it must not fall either."""
        with self._lock:
            self._check_rises(name, value)
            self._counters[name] = value
            if self._tally is not None:
                self._tally.set(name, value)

    def _check_rises(self, name: str, value: int) -> None:
        if value < self._counters[name]:
            raise ValueError(f"{name}: {value} after {self._counters[name]}: a counter does not fall")

    def counter(self, name: str) -> int:
        """The counter's value; 0 if nothing was counted."""
        with self._lock:
            return self._counters[name]  # a Counter does not keep what it was merely asked for

    def gauge(self, name: str, value: float) -> None:
        """Set a quantity that goes up and down."""
        with self._lock:
            self._gauges[name] = value

    def beat(self, now_ns: int) -> None:
        """Say that the process's own loop turns; at least once a second from that loop, and only from it."""
        self._beat_ns = now_ns

    def histogram(self, name: str) -> Histogram:
        """The histogram of that name, made on first use. Keep it: recording needs no ledger."""
        with self._lock:
            return self._histograms.setdefault(name, Histogram())

    def event(self, at_ns: int, level: Level, text: str) -> None:
        """Put a line on the timeline and into the log.

        Beyond 256 between two snapshots the oldest is dropped and counted as `events.dropped`, and
        the timeline gets the first 500 characters only; the log has everything.
        """
        self._logger.log(LOG_LEVELS[level], "%s", text)
        with self._lock:
            if self._unsent == MAX_EVENTS:
                self._counters[EVENTS_DROPPED] += 1
                if self._tally is not None:
                    self._tally.set(EVENTS_DROPPED, self._counters[EVENTS_DROPPED])
            self._unsent = min(self._unsent + 1, MAX_EVENTS)
            self._events.append(Event(at_ns=at_ns, level=level, text=text[:MAX_TEXT]))

    def episode(self, episode: EpisodeReturn) -> None:
        """Add the return of a finished episode."""
        with self._lock:
            self._returns.append(episode)

    def windows(self, windows: Sequence[WindowNotice]) -> None:
        """Replace the phases so far by this list."""
        with self._lock:
            self._windows = list(windows)

    def stats(self, at_ns: int, *, final: bool = False) -> Stats:
        """Everything so far, plus the events since the previous call and those of the last 10 s.

        Events are repeated for readers that came a little later; whoever shows them drops repeats.

        Returns and windows: the newest 64 and 4096, so that a reader loses none to a lost message;
        all of them when `final`.
        """
        with self._lock:
            seq, self._seq = self._seq, self._seq + 1
            while len(self._events) > self._unsent and self._events[0].at_ns < at_ns - REPEAT_NS:
                self._events.popleft()
            self._unsent = 0
            return Stats(
                process=self._process,
                incarnation=self._incarnation,
                seq=seq,
                at_ns=at_ns,
                final=final,
                counters=dict(self._counters),
                gauges=dict(self._gauges),
                histograms={name: histogram.to_bytes() for name, histogram in self._histograms.items()},
                events=list(self._events),
                returns=self._returns[0 if final else -RECENT_RETURNS :],
                windows=self._windows[0 if final else -RECENT_WINDOWS :],
                beat_ns=self._beat_ns,
            )


def brief(last: Stats) -> Stats:
    """A final ledger as it goes over the bus: with the newest `MOST_RETURNS` and 4096 windows. The file has
    all of them."""
    return replace(last, returns=last.returns[-MOST_RETURNS:], windows=last.windows[-RECENT_WINDOWS:])
