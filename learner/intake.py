"""From the env server's log to the replay: exactly once, in order, with the action really applied."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from learner.diary import Diary
from learner.place import Course, Place, Position
from learner.replay import Replay
from learner.store import MARGIN
from rtcore.bus import Bus
from rtcore.clock import Clock
from rtcore.ledger import Ledger
from rtcore.log_reader import LogReader
from rtcore.messages import Spec, Step
from rtcore.stream import Transitions

CAPACITY_BATCHES = 20_000  # at 20 a second, a quarter of an hour of a learner that does nothing
COUNTED = ("received", "learned", "duplicate", "gaps", "broken")

Taken = tuple[int, list[Step]]
"""Number of new transitions, and the steps."""


class Intake:
    """Feeds one environment's transitions to the replay, and its steps to the diary.

    Counts `received` (steps), `learned` (transitions in the replay), `duplicate`, `gaps` (steps that
    never came in time) and `broken` (steps that fit to no transition), each together with the commit:
    whatever kills the learner, its counters and those of the learners after it add up to what was committed.
    """

    def __init__(self, bus: Bus, env: str, clock: Clock, ledger: Ledger, diary: Diary) -> None:
        self._log = LogReader(bus, env, capacity_batches=CAPACITY_BATCHES)
        self._clock = clock
        self._ledger = ledger
        self._diary = diary
        self._transitions = Transitions()
        self._replay: Replay | None = None
        self._position: Position | None = None  # of what is in the replay
        self._counts: dict[str, int] = dict.fromkeys(COUNTED, 0)  # likewise, of this learner
        self._before: dict[str, int] = {}  # what earlier learners committed
        # less what they counted: above 0 if one was killed in between; below 0 if one went on in memory, then
        # what it took in comes again
        self._owed: dict[str, int] = {}

    @property
    def ended(self) -> bool:
        """Whether the env server ended in order and everything it sent is in."""
        return self._log.ended

    @property
    def replay_size(self) -> int:
        """Transitions in the replay."""
        return 0 if self._replay is None else len(self._replay)

    def meet(self, spec: Spec, replay: Replay, place: Place, counted: Mapping[str, int]) -> None:
        """Learn the shapes and the action space; until then everything waits in the queue.

        Args:
            spec: of the world.
            replay: where transitions go.
            place: where earlier learners of the run ended; go on right after it.
            counted: what their ledgers say.
        """
        self._replay = replay
        self._diary.meet(spec, place.acted)
        self._position = place.position
        self._log.go_on_from(place.position)
        self._transitions = Transitions(spec.observation_dim, spec.action_dim, place.previous)
        self._before = {name: place.counts.get(name, 0) for name in COUNTED}
        self._owed = {name: self._before[name] - counted.get(name, 0) for name in COUNTED}
        low, high = np.asarray(spec.action_low), np.asarray(spec.action_high)
        self._middle = ((high + low) / 2).astype(np.float32)
        self._half_span = ((high - low) / 2).astype(np.float32)
        if spec.actions:  # numbered: nothing to scale
            self._middle, self._half_span = np.zeros(1, np.float32), np.ones(1, np.float32)
        self._account(replay)

    def wait(self, timeout_s: float) -> None:
        """Wait until something has come, at most so long."""
        self._log.wait(timeout_s)

    def take(self, now_ns: int) -> Iterator[Taken]:
        """Move all that has come into the replay, in parts. Call `commit` after each."""
        if self._replay is not None:
            yield from self._learn(self._replay, self._log.read(now_ns))

    def finish(self) -> Iterator[Taken]:
        """Nothing follows: give up on gaps, take what waited behind them. Call `commit` after each."""
        if self._replay is not None:
            yield from self._learn(self._replay, self._log.finish())
            self._diary.finish()

    def commit(self, course: Course) -> None:
        """Let all that was taken in, and where that leaves the learner, survive it from now on."""
        if self._replay is None:
            return
        counts = {name: self._before[name] + count for name, count in self._counts.items()}
        place = Place(
            position=self._position,
            previous=self._transitions.previous,
            counts=counts,
            course=course,
            acted=self._diary.pending,
        )
        self._replay.commit(place.encode())
        self._account(self._replay)

    def _learn(self, replay: Replay, steps: list[Step]) -> Iterator[Taken]:
        for begin in range(0, len(steps), MARGIN):
            part = steps[begin : begin + MARGIN]
            before = self._transitions.transitions
            for step in part:
                self._add(replay, step)
            self._diary.acted(part)
            self._position = (part[-1].incarnation, part[-1].seq + 1)
            learned = self._transitions.transitions - before
            self._counts["learned"] += learned
            self._counts["broken"] = self._transitions.broken + self._transitions.invalid
            if part[-1] is steps[-1]:  # before, what the stream counts is ahead of what is in the replay
                stream = self._log.stream
                self._counts["received"] = stream.received
                self._counts["duplicate"] = stream.duplicate + stream.late
                self._counts["gaps"] = stream.gaps
            yield learned, part

    def _add(self, replay: Replay, step: Step) -> None:
        transition = self._transitions.feed(step)
        if transition is not None:
            replay.add(
                transition.obs,
                (transition.decision - self._middle) / self._half_span,  # the networks' range, [-1, 1]
                transition.reward,
                transition.next_obs,
                transition.terminated,
                transition.unit,
            )

    def _account(self, replay: Replay) -> None:
        for name, count in self._counts.items():
            self._ledger.set_counter(name, max(0, self._owed[name] + count))
        if replay.fault is None:
            return
        if self._ledger.counter("replay.unbacked") == 0:
            text = f"the replay goes on in memory, and no checkpoint is written any more: {replay.fault}"
            self._ledger.event(self._clock.now_ns(), "ERROR", text)
        self._ledger.set_counter("replay.unbacked", max(1, replay.unbacked))
