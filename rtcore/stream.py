"""From batches of steps as they arrive to transitions as they happened.

The log channel recovers what was lost, so its batches repeat, and older ones come after newer ones. A
transition needs two steps that followed each other. `StepStream` therefore puts steps back in order, each
once; `Transitions` pairs them.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
import numpy.typing as npt

from rtcore.messages import Step, StepBatch

# Steps that wait for an older one before that is given up. A recovered batch arrives within a second or two;
# 4000 steps are 4 s at 1 kHz and 80 s at 50 Hz, some 4 MB.
MAX_WAITING = 4000


class StepStream:
    """The steps of one environment in order, each (incarnation, seq) once.

    Within an incarnation of the env server `seq` counts from 0 without gaps. A step that arrives early
    waits until the missing ones come, or until they are given up: by `give_up`, by `flush`, by the start
    of a newer incarnation, or because more than `max_waiting` steps wait. A greater incarnation is newer.

    Attributes:
        received: steps fed in; always delivered + duplicate + late + waiting.
        delivered: steps handed out.
        duplicate: steps that had come before.
        late: steps that came after they had been given up, or after their incarnation.
        gaps: steps given up, so lost to the reader. What an incarnation that ended did after its last
            step seen here is not in it: nobody here knows of it.
        ended: the env server ended in order, and nothing before its end is missing. An end that steps of its
            incarnation follow was none.

    Args:
        position: (incarnation, seq) of the next step to hand out, where a restarted reader goes on;
            None: from the beginning of whichever incarnation comes first.
        max_waiting: in steps.
    """

    def __init__(self, position: tuple[int, int] | None = None, max_waiting: int = MAX_WAITING) -> None:
        self._incarnation, self._next = position if position is not None else (-1, 0)
        self._waiting: dict[int, Step] = {}
        self._lost: list[range] = []  # of this incarnation, to tell late from duplicate
        self._max_waiting = max_waiting
        self._end: int | None = None  # of this incarnation: the seq after its last
        self.received = 0
        self.delivered = 0
        self.duplicate = 0
        self.late = 0
        self.gaps = 0

    @property
    def position(self) -> tuple[int, int] | None:
        """(incarnation, seq) of the step that is due next; None before the first step."""
        return None if self._incarnation < 0 else (self._incarnation, self._next)

    @property
    def waiting(self) -> int:
        """Steps held back because an older one is missing."""
        return len(self._waiting)

    @property
    def ended(self) -> bool:
        """See the class."""
        return self._end is not None and not self._waiting

    def feed(self, batch: StepBatch) -> list[Step]:
        """Take a batch; return the steps that are due now, oldest first."""
        due: list[Step] = []
        for step in batch.steps:
            self.received += 1
            if step.incarnation > self._incarnation:
                due += self._begin(step.incarnation)
            self._keep(step)
        due += self._release()
        while len(self._waiting) > self._max_waiting:
            due += self.give_up()
        # An empty batch names no incarnation: it can only end the present one.
        if batch.last and all(step.incarnation == self._incarnation for step in batch.steps):
            self._end = max([self._next, *(seq + 1 for seq in self._waiting)])
        return due

    def give_up(self) -> list[Step]:
        """Count the oldest gap as lost; return the steps that it held back, up to the next gap."""
        if not self._waiting:
            return []
        oldest = min(self._waiting)
        self.gaps += oldest - self._next
        self._lost.append(range(self._next, oldest))
        self._next = oldest
        return self._release()

    def flush(self) -> list[Step]:
        """Count every gap as lost; return all steps that wait. For the end of the run."""
        due: list[Step] = []
        while self._waiting:
            due += self.give_up()
        return due

    def _begin(self, incarnation: int) -> list[Step]:
        rest = self._release() + self.flush()
        self._incarnation, self._next, self._end = incarnation, 0, None
        self._lost.clear()
        return rest

    def _keep(self, step: Step) -> None:
        if step.incarnation < self._incarnation:
            self.late += 1
        elif step.seq < self._next:
            at = bisect_right(self._lost, step.seq, key=attrgetter("start")) - 1  # they rise
            given_up = at >= 0 and step.seq in self._lost[at]
            self.late += given_up
            self.duplicate += not given_up
        elif step.seq in self._waiting:
            self.duplicate += 1
        else:
            self._waiting[step.seq] = step
            if self._end is not None and step.seq >= self._end:
                self._end = None

    def _release(self) -> list[Step]:
        due = []
        while (step := self._waiting.pop(self._next, None)) is not None:
            due.append(step)
            self._next += 1
        self.delivered += len(due)
        return due


@dataclass(frozen=True, slots=True, eq=False)
class Transition:
    """What happened between two observations that followed each other. Arrays are read-only views.

    Attributes:
        obs: o_{k-1}, float32 [observation_dim].
        decision: float32 [action_dim], environment units: what entered the delay line at D_k in answer to
            `obs`. Without delay it is the action applied over the tick; with a delay of d ticks it acts d
            ticks later (real-time MDP of Ramstedt & Pal). After a miss, the fallback.
        reward: earned over tick k.
        next_obs: o_k, float32 [observation_dim].
        terminated: the task ended with it: no future value.
        truncated: the time limit ended the episode: there is a future value, it was only not lived.
        unit: t, of step k.
        tick: k.
        incarnation: of the env server.
        seq: of step k; with `incarnation` it names the transition for good.
    """

    obs: npt.NDArray[np.float32]
    decision: npt.NDArray[np.float32]
    reward: float
    next_obs: npt.NDArray[np.float32]
    terminated: bool
    truncated: bool
    unit: int
    tick: int
    incarnation: int
    seq: int


class Transitions:
    """Pairs each step with the one before it; never across a reset, a gap or a restart of the env server.

    Attributes:
        transitions: built.
        resets: steps that begin an episode; they end no transition.
        broken: steps whose predecessor is unknown or does not lead to them, so no transition ends in them.
        invalid: steps of a wrong size or with a NaN or Inf in them; they are in no transition.
            So steps fed in = transitions + resets + broken + invalid.

    Args:
        observation_dim: of the spec; None: whatever the step before had.
        action_dim: of the spec; None: whatever comes, but not nothing.
        previous: the step before the first one, where a restarted reader goes on; see `previous` below.
    """

    def __init__(
        self,
        observation_dim: int | None = None,
        action_dim: int | None = None,
        previous: Step | None = None,
    ) -> None:
        self._observation_dim = observation_dim
        self._action_dim = action_dim
        self._previous = previous
        self.transitions = 0
        self.resets = 0
        self.broken = 0
        self.invalid = 0

    @property
    def previous(self) -> Step | None:
        """The step that the next one may follow. Kept in a checkpoint, it saves the transition there."""
        return self._previous

    def feed(self, step: Step) -> Transition | None:
        """Take the next step, in order; return the transition that ends in it, if one does."""
        previous = self._previous
        obs = _vector(previous.observation) if previous is not None else None
        next_obs, decision = _vector(step.observation), _vector(step.decision)
        if not self._valid(step, next_obs, decision):
            self.invalid += 1
            self._previous = None
            return None
        self._previous = step
        if step.episode_tick == 0:
            self.resets += 1
            return None
        if previous is None or obs is None or obs.size != next_obs.size or not _follows(step, previous):
            self.broken += 1
            return None
        self.transitions += 1
        return Transition(
            obs=obs,
            decision=decision,
            reward=step.reward,
            next_obs=next_obs,
            terminated=step.terminated,
            truncated=step.truncated,
            unit=step.unit,
            tick=step.tick,
            incarnation=step.incarnation,
            seq=step.seq,
        )

    def _valid(self, step: Step, obs: npt.NDArray[np.float32], decision: npt.NDArray[np.float32]) -> bool:
        if not obs.size or self._observation_dim not in (None, obs.size) or not np.isfinite(obs).all():
            return False
        if step.episode_tick == 0:
            return True  # a reset has neither decision nor reward
        if not decision.size or self._action_dim not in (None, decision.size):
            return False
        return bool(np.isfinite(decision).all()) and math.isfinite(step.reward)


def _follows(step: Step, previous: Step) -> bool:
    """Whether `previous` is the tick right before `step` in the same episode."""
    return (
        step.incarnation == previous.incarnation
        and step.seq == previous.seq + 1
        and step.episode == previous.episode
        and step.episode_tick == previous.episode_tick + 1
        and not (previous.terminated or previous.truncated)
    )


def _vector(data: bytes) -> npt.NDArray[np.float32]:
    """float32 [n] of little-endian bytes; empty where they are no whole number of floats."""
    return np.frombuffer(data, np.dtype("<f4")) if len(data) % 4 == 0 else np.empty(0, np.float32)
