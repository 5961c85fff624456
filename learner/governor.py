"""When the learner gives way to the tick, and when it takes its power back. Pure.

The evidence is in the logs: how much of its period each tick had used when the agent's answer was there,
and which deadlines were lost for want of a processor. The learner gives way at once, by half each time:
first threads, which pay least (a second one on two cores: from 96 down to 57 updates a second beside a
500 Hz loop, and four times the misses), then its share of the time. It comes back one level at a time,
after a clean while that doubles whenever coming back was too early.

Where the learner does not compute all the time there are ticks beside its work and ticks without. If those
without fare as badly, it is not the learner who does it, and giving way would be in vain.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

import numpy as np

from rtcore.messages import MissCause, Step

DUTIES = (1.0, 0.5, 0.25, 0.125)
WINDOW_S = 5.0  # of evidence: at 100 Hz 1 % are five ticks, and the shortest duty works several times
TIGHT = 0.8  # of the period used; the p99 at 500 Hz is 0.25 with SCHED_FIFO, 0.5 without, beside no learner
MAX_TIGHT_SHARE = 0.01  # so it is the 99th percentile that must stay below `TIGHT`
MAX_LOST_SHARE = 0.001  # the miss ratio that is promised without privileges at 500 Hz
MIN_PATIENCE_S, MAX_PATIENCE_S = 2.0, 64.0  # clean time before more power; a failed try lasts some 0.3 s
MIN_IDLE_SHARE = 0.125  # of a window: ticks without the learner that it takes to judge by them
REST_S = 60.0  # so long it is believed that giving way is in vain, unless things get twice as bad
# The others are nobody's want of a processor.
LEARNER_MAY_CAUSE: frozenset[MissCause] = frozenset({"agent_late", "agent_stalled", "transport", "env_late"})


@dataclass(frozen=True, slots=True)
class Power:
    """What the learner may use.

    Attributes:
        threads: of its arithmetic.
        duty: share of the time in which it computes.
    """

    threads: int
    duty: float = 1.0

    def describe(self, of_threads: int) -> str:
        """In a few words, beside the threads of full power."""
        threads = f"{self.threads} of {of_threads} threads" if of_threads > 1 else "1 thread"
        return f"{threads}, {'full' if self.duty == 1.0 else f'1/{1 / self.duty:.0f}'} duty"


def ladder(threads: int) -> tuple[Power, ...]:
    """From full power down: threads halved to one, then the duty halved."""
    halved = [threads]
    while halved[-1] > 1:
        halved.append(halved[-1] // 2)
    return (*map(Power, halved[:-1]), *(Power(1, duty) for duty in DUTIES))


@dataclass(frozen=True, slots=True)
class Decision:
    """A change of power, and what it is and why in a few words."""

    power: Power
    text: str


@dataclass(slots=True)
class Tally:
    """Ticks of one kind, and what became of them."""

    ticks: int = 0
    tight: int = 0  # more than `TIGHT` of the period used, or lost
    lost: int = 0  # runs of lost deadlines; one stall is one run, however long

    @property
    def tight_share(self) -> float:
        """0 without a tick."""
        return self.tight / self.ticks if self.ticks else 0.0


@dataclass(slots=True)
class Evidence:
    """The newest ticks at the present power, `size` at most."""

    size: int
    busy: Tally = field(default_factory=Tally)  # the learner worked within the tick
    idle: Tally = field(default_factory=Tally)
    _ticks: deque[tuple[float, bool, bool]] = field(default_factory=deque)  # (used, lost, busy)

    def add(self, used: float, *, lost: bool, busy: bool) -> None:
        """Enter a tick, and forget the oldest if there are too many."""
        if len(self._ticks) == self.size:
            self._enter(*self._ticks.popleft(), sign=-1)
        self._ticks.append((used, lost, busy))
        self._enter(used, lost, busy, sign=1)

    def load(self) -> float:
        """99th percentile of the share of the period that was used."""
        return float(np.quantile([used for used, _, _ in self._ticks], 0.99)) if self._ticks else 0.0

    @property
    def troubled(self) -> bool:
        """Whether more went wrong beside the learner's work than may go wrong in a whole window."""
        tight, lost = max(1.0, MAX_TIGHT_SHARE * self.size), max(1.0, MAX_LOST_SHARE * self.size)
        return self.busy.tight > tight or self.busy.lost > lost  # a single one is no pattern

    @property
    def in_vain(self) -> bool:
        """Whether ticks fare about as badly without the learner, as far as there are enough of them."""
        enough = self.idle.ticks >= MIN_IDLE_SHARE * self.size
        return enough and 2 * self.idle.tight_share > self.busy.tight_share

    def worse_than(self, share: float) -> bool:
        """Whether more than this share of the ticks beside the learner is tight, in half a window or more."""
        return 2 * self.busy.ticks >= self.size and self.busy.tight_share > share

    def _enter(self, used: float, lost: bool, busy: bool, *, sign: int) -> None:
        tally = self.busy if busy else self.idle
        tally.ticks += sign
        tally.tight += sign * (used > TIGHT)
        tally.lost += sign * lost


@dataclass(slots=True)
class Loop:
    """One agent's ticks since the power changed last, and what the learner did beside them."""

    tick_ns: int
    evidence: Evidence
    clean: int = 0  # busy ticks since the last change or trouble
    risen_for: int | None = None  # ticks since power was taken back; None: it was given up since
    rest: int = 0  # ticks for which giving way is known to be in vain
    excused_share: float = 0.0  # of tight ticks without the learner, as it was found then
    fed_ns: int = 0  # when something of it came last
    _previous: Step | None = None
    _previous_lost: bool = False
    _work: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=4096))  # (begin, end)

    def worked(self, begin_ns: int, end_ns: int) -> None:
        """The learner computed from `begin_ns` to `end_ns`."""
        if self._work and begin_ns - self._work[-1][1] < self.tick_ns:
            begin_ns = self._work.pop()[0]
        self._work.append((begin_ns, end_ns))

    def take(self, step: Step, since_ns: int) -> None:
        """The next step of the log. What began before `since_ns` is no evidence."""
        previous, self._previous = self._previous, step
        used = None if previous is None else self._used(previous, step)
        lost = used is not None and (step.missed or step.skipped > 0)
        begins, self._previous_lost = lost and not self._previous_lost, lost
        if previous is None or used is None or previous.due_ns < since_ns:
            return
        busy = self._was_busy(previous.due_ns, max(step.due_ns, step.woke_ns))
        if self.risen_for is not None:
            self.risen_for += 1
        self.evidence.add(used, lost=begins, busy=busy)
        if self.rest:
            self.rest -= 1
        else:
            self.clean += busy

    def begin_anew(self) -> None:
        """The power has changed: evidence from before counts no more."""
        self.clean = 0
        self.evidence = Evidence(self.evidence.size)

    def _used(self, previous: Step, step: Step) -> float | None:
        """Share of the period that had passed when the answer was there; None: this tick says nothing."""
        follows = step.incarnation == previous.incarnation and step.seq == previous.seq + 1
        if not follows or step.episode_tick == 0:  # a reset waits for no answer
            return None
        if step.missed and step.cause not in LEARNER_MAY_CAUSE:
            return None
        if step.missed or step.skipped:
            return 1.0
        if step.loop_ns < 0:
            return None
        return (previous.sent_ns + step.loop_ns - previous.due_ns) / self.tick_ns

    def _was_busy(self, begin_ns: int, end_ns: int) -> bool:
        while self._work and self._work[0][1] <= begin_ns:
            self._work.popleft()  # steps come in order: nobody asks about it again
        return bool(self._work) and self._work[0][0] < end_ns


class Governor:
    """Feeds on the logs, and decides on the learner's power.

    Begins with one thread: a learner of several earns the others. Of several agents each is watched by
    itself: the learner gives way to whichever is in trouble, and takes power back when none has been for a
    while. Time is counted in ticks that come in the logs, so without an env server the power stays as it is,
    and one of several that is gone says nothing.
    """

    def __init__(self, threads: int, tick_ns: int, envs: Collection[str]) -> None:
        """`envs`: the environments' names, as in their steps."""
        self._tick_ns = tick_ns
        self._levels = ladder(threads)
        self._careful = len(self._levels) - len(DUTIES)  # the level of one thread at full duty
        self._level = self._careful
        self._changed_ns = 0  # evidence from before counts no more
        self._loops = {env: Loop(tick_ns, Evidence(self._in_ticks(WINDOW_S))) for env in envs}
        self._patience_s = MIN_PATIENCE_S

    @property
    def power(self) -> Power:
        """What the learner may use now."""
        return self._levels[self._level]

    @property
    def limited(self) -> bool:
        """Whether that is less than everything."""
        return self._level > 0

    @property
    def load(self) -> float:
        """99th percentile, over the last seconds, of the share of the period used up to the answer: that of
        the agent for which it is highest."""
        return max(loop.evidence.load() for loop in self._loops.values())

    def worked(self, begin_ns: int, end_ns: int) -> None:
        """The learner computed from `begin_ns` to `end_ns`. Call it in order, before the ticks in it come."""
        for loop in self._loops.values():
            loop.worked(begin_ns, end_ns)

    def feed(self, steps: Iterable[Step], now_ns: int) -> Decision | None:
        """Take the next steps of the logs, those of each in order; return what is decided at `now_ns`, if
        anything is."""
        for step in steps:
            loop = self._loops[step.env]
            loop.take(step, self._changed_ns)
            loop.fed_ns = now_ns
        recent_ns = now_ns - round(WINDOW_S * 1e9)
        awake = [one for one in self._loops.values() if one.fed_ns > recent_ns and not self._rests(one)]
        troubled = [loop for loop in awake if loop.evidence.troubled]
        if troubled:  # one that giving way helps comes before one that it does not
            return self._give_way(min(troubled, key=lambda loop: loop.evidence.in_vain), now_ns)
        patience = self._in_ticks(self._patience_s) * self.power.duty
        if self.limited and any(loop.clean >= patience for loop in awake):
            for loop in self._loops.values():
                loop.risen_for = 0
            return self._go_to(self._level - 1, now_ns, f"{self._patience_s:g} s without trouble")
        return None

    def _rests(self, loop: Loop) -> bool:
        if loop.rest > 0 and not loop.evidence.worse_than(2 * loop.excused_share):
            return True
        loop.rest = 0
        return False

    def _give_way(self, loop: Loop, now_ns: int) -> Decision | None:
        """To the agent of that loop."""
        evidence = loop.evidence
        for one in self._loops.values():
            one.clean = 0
        if evidence.in_vain:
            busy, idle = evidence.busy.tight_share, evidence.idle.tight_share
            loop.rest, loop.excused_share = self._in_ticks(REST_S), idle
            reason = f"giving way would not help: {busy:.1%} of the ticks tight beside it, {idle:.1%} without"
            return self._go_to(min(self._level, self._careful), now_ns, reason)
        if self._level == len(self._levels) - 1:
            return None
        if loop.risen_for is not None:
            soon = loop.risen_for < self._in_ticks(self._patience_s + WINDOW_S)
            self._patience_s = min(2 * self._patience_s, MAX_PATIENCE_S) if soon else MIN_PATIENCE_S
        for one in self._loops.values():
            one.risen_for = None
        misses = evidence.busy.lost
        reason = f"p99 of the loop took {evidence.load():.0%} of the period, deadlines lost {misses} times"
        return self._go_to(self._level + 1, now_ns, reason)

    def _go_to(self, level: int, now_ns: int, reason: str) -> Decision:
        self._level = level
        self._changed_ns = now_ns
        for loop in self._loops.values():
            loop.begin_anew()
        return Decision(self.power, f"{self.power.describe(self._levels[0].threads)}: {reason}")

    def _in_ticks(self, seconds: float) -> int:
        return max(1, round(seconds * 1e9 / self._tick_ns))
