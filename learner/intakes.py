"""From the logs of all environments of a run to one replay."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from heapq import merge
from operator import attrgetter
from typing import NamedTuple

from msgspec.structs import replace

from learner.diary import Diary
from learner.intake import COUNTED, Intake
from learner.place import Course, Place
from learner.replay import Replay
from learner.store import MARGIN
from rtcore import channels
from rtcore.admission import check_same_task, is_same_world
from rtcore.bus import Bus
from rtcore.clock import Clock
from rtcore.ledger import Ledger
from rtcore.messages import Spec, Step

# At 20 batches a second, a quarter of an hour of a learner that does nothing. A fleet shares it, but each
# environment has room for all of its env server's cache, which may come at once, and some seconds more.
CAPACITY_BATCHES, LEAST_BATCHES = 20_000, 2_500


class Taken(NamedTuple):
    """A part of what came."""

    learned: int  # new transitions
    steps: list[Step]  # those of an environment in order


class Intakes:
    """Feeds the transitions of all environments to the replay, and their steps to the diary.

    Counts `received` (steps), `learned` (transitions in the replay), `duplicate`, `gaps` (steps that
    never came in time) and `broken` (steps that fit to no transition), each together with the commit:
    whatever kills the learner, its counters and those of the learners after it add up to what was committed.
    Of a fleet each of them as `learned.<env>` too: they add up to `learned`.

    An environment of another task than the first one that declared itself is refused for good.
    """

    def __init__(self, bus: Bus, envs: Sequence[str], clock: Clock, ledger: Ledger, diary: Diary) -> None:
        self._bus, self._clock, self._ledger, self._diary = bus, clock, ledger, diary
        self._specs = {env: bus.latest(channels.SPEC, env) for env in envs}
        capacity = max(CAPACITY_BATCHES // len(envs), LEAST_BATCHES)
        self._intakes = {env: Intake(bus, env, capacity) for env in envs}
        self._replay: Replay | None = None
        self._task: Spec | None = None  # the first declaration of all
        # What earlier learners committed less what they counted: above 0 if one was killed in between; below
        # 0 if one went on in memory, then what it took in comes again.
        self._owed: dict[str, int] = {}

    @property
    def envs(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(self._intakes)

    @property
    def ended(self) -> bool:
        """Whether all env servers ended in order and everything they sent is in."""
        return all(intake.ended for intake in self._intakes.values())

    @property
    def replay_size(self) -> int:
        """Transitions in the replay."""
        return 0 if self._replay is None else len(self._replay)

    def declared(self) -> Spec | None:
        """The task, as soon as one of the environments has declared itself."""
        for reader in self._specs.values():
            received = reader.take()
            if received is not None:
                return received.message
        return None

    def meet(self, spec: Spec, replay: Replay, place: Place, counted: Mapping[str, int]) -> None:
        """Learn the shapes and the action space; until then everything waits in the queues.

        Args:
            spec: what was `declared`.
            replay: where transitions go.
            place: where earlier learners of the run ended; go on right after it.
            counted: what their ledgers say.
        """
        self._replay, self._task = replay, spec
        acted = {env: one.acted for env, one in place.envs.items() if one.acted is not None}
        self._diary.meet(spec, self.envs, acted)
        for env, intake in self._intakes.items():
            intake.meet(spec, place.envs[env])
        self._intakes[spec.env].declared = spec
        before = self._named({env: intake.before for env, intake in self._intakes.items()})
        self._owed = {name: count - counted.get(name, 0) for name, count in before.items()}
        self._account(replay)

    def wait(self, timeout_s: float) -> None:
        """Wait until something has come, at most so long.

        A queue wakes its own reader alone, so of a fleet the first environment that goes on is waited for;
        what another one sends meanwhile is taken in as late as that.
        """
        waiting = [intake for intake in self._intakes.values() if intake.declared is not None]
        going_on = [intake for intake in waiting if not intake.ended]
        for intake in (going_on or waiting)[:1]:
            intake.wait(timeout_s)

    def take(self, now_ns: int) -> Iterator[Taken]:
        """Move all that has come into the replay, in parts. Call `commit` after each."""
        if self._replay is not None:
            for env, reader in self._specs.items():
                received = reader.take()
                if received is not None:
                    self._hear(self._intakes[env], received.message)
            yield from self._learn(self._replay, [intake.read(now_ns) for intake in self._intakes.values()])

    def finish(self) -> Iterator[Taken]:
        """Nothing follows: give up on gaps, take what waited behind them. Call `commit` after each."""
        if self._replay is not None:
            yield from self._learn(self._replay, [intake.finish() for intake in self._intakes.values()])
            self._diary.finish()

    def commit(self, course: Course) -> None:
        """Let all that was taken in, and where that leaves the learner, survive it from now on."""
        if self._replay is None:
            return
        acted = self._diary.pending
        envs = {env: replace(intake.progress, acted=acted.get(env)) for env, intake in self._intakes.items()}
        self._replay.commit(Place(envs=envs, course=course).encode())
        self._account(self._replay)

    def _hear(self, intake: Intake, spec: Spec) -> None:
        """An environment declared itself, or a new life of its env server did."""
        assert self._task is not None
        if intake.declared is not None:
            if spec.incarnation != intake.declared.incarnation and is_same_world(spec, intake.declared):
                who = "the env server" + (f" of {intake.env}" if len(self._intakes) > 1 else "")
                text = f"{who} came back; units and windows go on by its first clock"
                self._ledger.event(self._clock.now_ns(), "WARN", text)
            return
        try:
            check_same_task(spec, self._task)
            if intake.refused:
                raise ValueError("it was refused before")
        except ValueError as error:
            self._bus.reject(channels.SPEC, f"{intake.env}: {error}")
            if not intake.refused:
                text = f"nothing is learned from {intake.env}, another task than {self._task.env}: {error}"
                self._ledger.event(self._clock.now_ns(), "ERROR", text)
            intake.refused = True
            return
        intake.declared = spec

    def _learn(self, replay: Replay, logs: list[list[Step]]) -> Iterator[Taken]:
        """By tick, so that units rise although a lot may have come of each."""
        steps = list(merge(*logs, key=attrgetter("tick")))
        for begin in range(0, len(steps), MARGIN):
            part = steps[begin : begin + MARGIN]
            learned = sum(self._intakes[step.env].learn(replay, step) for step in part)
            self._diary.acted(part)
            if part[-1] is steps[-1]:
                for intake in self._intakes.values():
                    intake.count_stream()
            yield Taken(learned, part)

    def _account(self, replay: Replay) -> None:
        counts = self._named({env: intake.counts for env, intake in self._intakes.items()})
        for name, count in counts.items():
            self._ledger.set_counter(name, max(0, self._owed[name] + count))
        if replay.fault is None:
            return
        if self._ledger.counter("replay.unbacked") == 0:
            text = f"the replay goes on in memory, and no checkpoint is written any more: {replay.fault}"
            self._ledger.event(self._clock.now_ns(), "ERROR", text)
        self._ledger.set_counter("replay.unbacked", max(1, replay.unbacked))

    def _named(self, counts: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
        """Counts by environment as the ledger calls them."""
        named = {name: sum(one[name] for one in counts.values()) for name in COUNTED}
        if len(counts) > 1:
            named |= {f"{name}.{env}": one[name] for env, one in counts.items() for name in COUNTED}
        return named
