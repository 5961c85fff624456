"""From the env server's log to the replay: exactly once, in order, with the action really applied."""

from __future__ import annotations

import msgspec
import numpy as np

from learner.diary import Diary
from learner.replay import Replay
from rtcore.bus import Bus
from rtcore.ledger import Ledger
from rtcore.log_reader import LogReader
from rtcore.messages import Spec, Step
from rtcore.stream import Transitions

CAPACITY_BATCHES = 20_000  # at 20 a second, a quarter of an hour of a learner that does nothing


class Intake:
    """Feeds one environment's transitions to the replay, and its steps to the diary.

    Counts `received` (steps), `learned` (transitions in the replay), `duplicate`, `gaps` (steps that
    never came in time) and `broken` (steps that fit to no transition).
    """

    def __init__(self, bus: Bus, env: str, ledger: Ledger, diary: Diary) -> None:
        self._log = LogReader(bus, env, capacity_batches=CAPACITY_BATCHES)
        self._ledger = ledger
        self._diary = diary
        self._transitions = Transitions()
        self._replay: Replay | None = None

    @property
    def ended(self) -> bool:
        """Whether the env server ended in order and everything it sent is in."""
        return self._log.ended

    @property
    def replay_size(self) -> int:
        """Transitions in the replay."""
        return 0 if self._replay is None else len(self._replay)

    def meet(self, spec: Spec, replay: Replay) -> None:
        """Learn the shapes and the action space; until then everything waits in the queue."""
        self._replay = replay
        self._diary.meet(spec)
        self._dims = (spec.observation_dim, spec.action_dim)
        self._transitions = Transitions(*self._dims)
        low, high = np.asarray(spec.action_low), np.asarray(spec.action_high)
        self._middle = ((high + low) / 2).astype(np.float32)
        self._half_span = ((high - low) / 2).astype(np.float32)
        if spec.actions:  # numbered: nothing to scale
            self._middle, self._half_span = np.zeros(1, np.float32), np.ones(1, np.float32)

    def place(self) -> str:
        """Where in the log the intake stands, for `go_on_from` in a later learner."""
        return msgspec.json.encode((self._log.stream.position, self._transitions.previous)).decode()

    def go_on_from(self, place: str) -> None:
        """Go on right after what an earlier learner took in. Call it after `meet`."""
        position, previous = msgspec.json.decode(place, type=tuple[tuple[int, int] | None, Step | None])
        self._log.go_on_from(position)
        self._transitions = Transitions(*self._dims, previous)

    def wait(self, timeout_s: float) -> None:
        """Wait until something has come, at most so long."""
        self._log.wait(timeout_s)

    def take(self, now_ns: int) -> tuple[int, list[Step]]:
        """Move all that has come into the replay; returns the number of new transitions, and the steps."""
        if self._replay is None:
            return 0, []
        steps = self._log.read(now_ns)
        return self._learn(self._replay, steps), steps

    def finish(self) -> None:
        """Nothing follows: give up on gaps, take what waited behind them, and put the replay on disk."""
        if self._replay is not None:
            self._learn(self._replay, self._log.finish())
            self._replay.flush()
            self._diary.finish()

    def _learn(self, replay: Replay, steps: list[Step]) -> int:
        if not steps:
            return 0
        before = self._transitions.transitions
        for step in steps:
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
        self._diary.acted(steps)
        self._account()
        return self._transitions.transitions - before

    def _account(self) -> None:
        stream, transitions = self._log.stream, self._transitions
        self._ledger.set_counter("received", stream.received)
        self._ledger.set_counter("learned", transitions.transitions)
        self._ledger.set_counter("duplicate", stream.duplicate + stream.late)
        self._ledger.set_counter("gaps", stream.gaps)
        self._ledger.set_counter("broken", transitions.broken + transitions.invalid)
