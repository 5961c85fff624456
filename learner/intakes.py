"""From the logs of all environments of a run to one replay."""

from __future__ import annotations

from collections import Counter
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
from rtcore import cast, channels
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
    Of a fleet each of them as `learned.<env>` too: they add up to `learned`. Besides `replay.raised`, the
    transitions that were filed under a newer unit than their own, because another environment was ahead.

    An environment of another task than the first one that declared itself is refused for good; the steps of
    it that come are `refused.<env>`.
    """

    def __init__(self, bus: Bus, envs: Sequence[str], clock: Clock, ledger: Ledger, diary: Diary) -> None:
        self._bus, self._clock, self._ledger, self._diary = bus, clock, ledger, diary
        self._specs = {env: bus.latest(channels.SPEC, env) for env in envs}
        capacity = max(CAPACITY_BATCHES // len(envs), LEAST_BATCHES)
        self._intakes = {env: Intake(bus, env, capacity) for env in envs}
        self._fleet = len(envs) > 1
        self._replay: Replay | None = None
        self._task: Spec | None = None  # the first declaration of all
        # What earlier learners committed less what they counted: above 0 if one was killed in between; below
        # 0 if one went on in memory, then what it took in comes again.
        self._owed: dict[tuple[str, str], int] = {}  # by environment and counter
        self._short: Counter[str] = Counter()  # of the totals, where one was killed before it came to them

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
        """The task, as soon as one of the environments has declared itself. Its T0 is the run's, whichever
        did."""
        for number, reader in enumerate(self._specs.values()):
            received = reader.take()
            if received is not None:
                return self._of_the_run(received.message, number)
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
        self._intakes[spec.env].accept(spec)
        for env, intake in self._intakes.items():
            for name, count in intake.before.items():
                told = counted.get(self._name(name, env), 0)
                self._owed[env, name] = count - told
                self._short[name] += told
        self._short.subtract({name: counted.get(name, 0) for name in COUNTED})
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
            for env, intake in self._intakes.items():
                if intake.refused:
                    self._ledger.count(f"refused.{env}", intake.discard())
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
                who = "the env server" + (f" of {intake.env}" if self._fleet else "")
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
        intake.accept(spec)

    def _learn(self, replay: Replay, logs: list[list[Step]]) -> Iterator[Taken]:
        """By tick, so that units rise although a lot may have come of each."""
        steps = list(merge(*logs, key=attrgetter("tick")))
        for begin in range(0, len(steps), MARGIN):
            part = steps[begin : begin + MARGIN]
            learned = sum(self._intakes[step.env].learn(replay, step) for step in part)
            self._diary.acted(part)
            yield Taken(learned, part)

    def _account(self, replay: Replay) -> None:
        total = self._short.copy()
        for env, intake in self._intakes.items():
            for name, count in intake.counts.items():
                told = max(0, self._owed[env, name] + count)
                total[name] += told
                self._ledger.set_counter(self._name(name, env), told)
        if self._fleet:
            for name, count in (*total.items(), ("replay.raised", replay.raised_units)):
                self._ledger.set_counter(name, count)
        if replay.fault is None:
            return
        if self._ledger.counter("replay.unbacked") == 0:
            text = f"the replay goes on in memory, and no checkpoint is written any more: {replay.fault}"
            self._ledger.event(self._clock.now_ns(), "ERROR", text)
        self._ledger.set_counter("replay.unbacked", max(1, replay.unbacked))

    def _name(self, counter: str, env: str) -> str:
        """As the ledger calls it."""
        return f"{counter}.{env}" if self._fleet else counter

    def _of_the_run(self, spec: Spec, number: int) -> Spec:
        """The declaration of environment `number` with the T0 that it is shifted against."""
        offset_ns = cast.offset_ns(number, len(self._specs), spec.tick_ns)
        return replace(spec, t0_ns=spec.t0_ns - offset_ns, wall_t0_ns=spec.wall_t0_ns - offset_ns)
