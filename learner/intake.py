"""From the env server's log to the replay: exactly once, in order, with the action really applied."""

from __future__ import annotations

import numpy as np

from learner.replay import Replay
from rtcore import channels
from rtcore.bus import Bus
from rtcore.ledger import Ledger
from rtcore.messages import Spec, Step
from rtcore.stream import StepStream, Transitions

CAPACITY = 20_000  # batches; at 20 a second, a quarter of an hour of a learner that does nothing


class Intake:
    """Feeds one environment's transitions to the replay.

    Counts `received` (steps), `learned` (transitions in the replay), `duplicate`, `gaps` (steps that
    never came) and `broken` (steps that fit to no transition).
    """

    def __init__(self, bus: Bus, env: str, ledger: Ledger) -> None:
        self._batches = bus.queue(channels.LOG, env, capacity=CAPACITY)
        self._ledger = ledger
        self._stream = StepStream()
        self._transitions = Transitions()
        self._replay: Replay | None = None

    @property
    def ended(self) -> bool:
        """Whether the env server ended in order and everything it sent is in."""
        return self._stream.ended

    @property
    def replay_size(self) -> int:
        """Transitions in the replay."""
        return 0 if self._replay is None else len(self._replay)

    def meet(self, spec: Spec, replay: Replay) -> None:
        """Learn the shapes and the action space; until then everything waits in the queue."""
        self._replay = replay
        self._transitions = Transitions(spec.observation_dim, spec.action_dim)
        low, high = np.asarray(spec.action_low), np.asarray(spec.action_high)
        self._middle = ((high + low) / 2).astype(np.float32)
        self._half_span = ((high - low) / 2).astype(np.float32)

    def wait(self, timeout_s: float) -> None:
        """Wait until something has come, at most so long."""
        self._batches.wait(timeout_s)

    def take(self) -> int:
        """Move all that has come into the replay; returns the number of new transitions."""
        if self._replay is None:
            return 0
        steps: list[Step] = []
        for received in self._batches.drain():
            steps += self._stream.feed(received.message)
        return self._learn(self._replay, steps)

    def finish(self) -> int:
        """Nothing follows: give up on gaps and take what waited behind them."""
        return 0 if self._replay is None else self._learn(self._replay, self._stream.flush())

    def _learn(self, replay: Replay, steps: list[Step]) -> int:
        learned = 0
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
                learned += 1
        self._ledger.set_counter("received", self._stream.received)
        self._ledger.set_counter("learned", self._transitions.transitions)
        self._ledger.set_counter("duplicate", self._stream.duplicate)
        self._ledger.set_counter("gaps", self._stream.gaps)
        self._ledger.set_counter("broken", self._transitions.broken + self._transitions.invalid)
        self._ledger.set_counter("log.dropped", self._batches.dropped)
        return learned
