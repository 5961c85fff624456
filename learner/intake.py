"""From an env server's log to the replay: exactly once, in order, with the action really applied."""

from __future__ import annotations

import numpy as np

from learner.place import Position, Progress
from learner.replay import Replay
from rtcore.bus import Bus
from rtcore.log_reader import LogReader
from rtcore.messages import Spec, Step
from rtcore.stream import Transitions

COUNTED = ("received", "learned", "duplicate", "gaps", "broken")


class Intake:
    """Feeds one environment's transitions to the replay.

    Attributes:
        env: its name.
        declared: of what it declared, the one that was accepted; None: nothing of it is read yet.
        refused: it declared another task: nothing of it is read.
        counts: of this learner, by `COUNTED`, up to the step that was learned last; of repeated ones all that
            came. So `received` is what was taken in and what was repeated.
        before: what earlier learners of the run committed, likewise.
    """

    def __init__(self, bus: Bus, env: str, capacity_batches: int) -> None:
        self.env = env
        self.declared: Spec | None = None
        self.refused = False
        self.counts: dict[str, int] = dict.fromkeys(COUNTED, 0)
        self.before: dict[str, int] = dict.fromkeys(COUNTED, 0)
        self._log = LogReader(bus, env, capacity_batches=capacity_batches)
        self._transitions = Transitions()
        self._position: Position | None = None  # of what is in the replay

    @property
    def ended(self) -> bool:
        """Whether the env server ended in order and everything it sent is in, or nothing of it is read."""
        return self.refused or self._log.ended

    @property
    def progress(self) -> Progress:
        """Where a later learner goes on, without what the diary has."""
        counts = {name: self.before[name] + count for name, count in self.counts.items()}
        return Progress(position=self._position, previous=self._transitions.previous, counts=counts)

    def meet(self, spec: Spec, progress: Progress) -> None:
        """Learn the shapes and the action space, and where earlier learners of the run ended: it goes on
        right after it. Until its own declaration is accepted everything waits in the queue.

        Args:
            spec: of the task.
            progress: of the environment.
        """
        self._position = progress.position
        self._log.go_on_from(progress.position)
        self._transitions = Transitions(spec.observation_dim, spec.action_dim, progress.previous)
        self.before = {name: progress.counts.get(name, 0) for name in COUNTED}
        low, high = np.asarray(spec.action_low), np.asarray(spec.action_high)
        self._middle = ((high + low) / 2).astype(np.float32)
        self._half_span = ((high - low) / 2).astype(np.float32)
        if spec.actions:  # numbered: nothing to scale
            self._middle, self._half_span = np.zeros(1, np.float32), np.ones(1, np.float32)

    def accept(self, spec: Spec) -> None:
        """Read it from now on, as the world that it declared."""
        self.declared = spec
        self._log.expect(spec)

    def wait(self, timeout_s: float) -> None:
        """Wait until something has come, at most so long."""
        self._log.wait(timeout_s)

    def read(self, now_ns: int) -> list[Step]:
        """What has come, in order: `learn` from each."""
        if self.declared is None:
            return []
        steps, stream = self._log.read(now_ns), self._log.stream
        repeated = stream.duplicate + stream.late
        self.counts["received"] += repeated - self.counts["duplicate"]
        self.counts["duplicate"] = repeated
        return steps

    def discard(self) -> int:
        """Leave unread what has come; returns the number of steps. For one that was refused."""
        return self._log.discard()

    def finish(self) -> list[Step]:
        """Nothing follows: give up on gaps, and return what waited behind them."""
        return [] if self.declared is None else self._log.finish()

    def learn(self, replay: Replay, step: Step) -> int:
        """Take the next step; returns the number of new transitions in the replay."""
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
        due = self._position[1] if self._position and self._position[0] == step.incarnation else 0
        self.counts["gaps"] += step.seq - due  # those of the stream are ahead of the replay
        self.counts["received"] += 1
        self._position = (step.incarnation, step.seq + 1)
        learned = self._transitions.transitions - self.counts["learned"]
        self.counts["learned"] += learned
        self.counts["broken"] = self._transitions.broken + self._transitions.invalid
        return learned
