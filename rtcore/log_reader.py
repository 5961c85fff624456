"""Reading the env server's log: the bus's batches as steps in order, each once."""

from __future__ import annotations

from collections import deque

from rtcore import channels
from rtcore.admission import check_same_world, is_same_world
from rtcore.bus import Bus
from rtcore.epoch import this_boot
from rtcore.messages import Spec, Step, StepBatch
from rtcore.stream import StepStream

PATIENCE_NS = 5_000_000_000  # a missing step is waited for so long; the bus recovers one within 2 s
MAX_DECLARED = 256  # incarnations remembered, the newest
MAX_UNDECLARED = 256  # batches that wait for a declaration: 13 s of a log
# A tick is over only after its deadline, by the clock of the host that declared it. Without a host, as in
# virtual time, roughly so; another host's clock says nothing here.
SLACK_TICKS = 1_000


class LogReader:
    """One reader's place in the log of one environment.

    A batch is taken from an incarnation that has declared itself; one that comes before its declaration waits
    for it. What nobody declares, or what lies in the future, is refused and counted on the log's channel: as
    a newer incarnation, or a later step, it would end the true one, or make it late.

    Attributes:
        stream: its counters tell what came, came twice, and never came.
    """

    def __init__(self, bus: Bus, env: str, *, capacity_batches: int) -> None:
        self._bus = bus
        self._specs = bus.queue(channels.SPEC, env, capacity=MAX_DECLARED)
        self._batches = bus.queue(channels.LOG, env, capacity=capacity_batches)
        self._capacity = capacity_batches
        self._world: Spec | None = None  # what it is, whoever declares it
        self._declared: dict[int, Spec] = {}
        self._undeclared: deque[tuple[int, StepBatch]] = deque()  # with the instant at which it was read
        self._waiting_since_ns: int | None = None  # a step is missing since then
        self._boot = ""
        self.stream = StepStream()

    def go_on_from(self, position: tuple[int, int] | None) -> None:
        """Begin at this (incarnation, seq), where an earlier reader ended. Call it before reading."""
        self.stream = StepStream(position)

    def expect(self, spec: Spec) -> None:
        """Take what the caller has accepted for what the world is: a declaration of another one is refused,
        whichever came first."""
        self._world = spec
        foreign = [key for key, one in self._declared.items() if not is_same_world(one, spec)]
        for incarnation in foreign:
            del self._declared[incarnation]
            self._bus.reject(channels.SPEC, f"incarnation {incarnation}: another world than the one expected")

    @property
    def ended(self) -> bool:
        """Whether the env server ended in order and everything before its end was read."""
        return self.stream.ended

    def wait(self, timeout_s: float) -> None:
        """Wait until something has come, at most so long."""
        self._batches.wait(timeout_s)

    def read(self, now_ns: int) -> list[Step]:
        """New steps; those behind a missing one come when it does, or 5 s later without it."""
        steps: list[Step] = []
        # First the batches: what they hold was declared before.
        received = self._batches.drain()
        for declared in self._specs.drain():
            self._declare(declared.message)
        # What came after the caller had looked at its clock is not of the future.
        latest_ns = max([now_ns, *(one.received_ns for one in received)])
        for batch in self._admitted([one.message for one in received], latest_ns):
            steps += self.stream.feed(batch)
        if not self.stream.waiting:
            self._waiting_since_ns = None
        elif self._waiting_since_ns is None or steps:
            self._waiting_since_ns = now_ns
        elif now_ns - self._waiting_since_ns >= PATIENCE_NS:
            self._waiting_since_ns = now_ns
            steps += self.stream.give_up()
        return steps

    def finish(self) -> list[Step]:
        """Nothing follows: give up on what is missing, and return what waited behind it."""
        for _ in self._undeclared:
            self._refuse("an env server that never declared itself")
        self._undeclared.clear()
        return self.stream.flush()

    def discard(self) -> int:
        """Leave unread what has come, instead of reading; returns the number of steps."""
        self._specs.drain()
        batches = [batch for _, batch in self._undeclared]
        batches += [received.message for received in self._batches.drain()]
        self._undeclared.clear()
        return sum(len(batch.steps) for batch in batches)

    def _declare(self, spec: Spec) -> None:
        self._world = self._world or spec
        try:
            check_same_world(spec, self._world)
        except ValueError as error:
            self._bus.reject(channels.SPEC, error)
            return
        self._boot = self._boot or this_boot()
        self._declared[spec.incarnation] = spec
        if len(self._declared) > MAX_DECLARED:
            del self._declared[min(list(self._declared)[1:])]  # the first one stays

    def _admitted(self, batches: list[StepBatch], now_ns: int) -> list[StepBatch]:
        """What may be taken now, oldest first."""
        waiting, self._undeclared = self._undeclared, deque()
        admitted: list[StepBatch] = []
        for since_ns, batch in [*waiting, *((now_ns, batch) for batch in batches)]:
            spec = self._declared.get(batch.steps[0].incarnation) if batch.steps else None
            if spec is None and batch.steps:
                self._defer(since_ns, batch, now_ns)
            elif spec is not None and batch.steps[-1].tick > self._newest_tick(spec, now_ns):
                self._refuse(f"tick {batch.steps[-1].tick} of the future")
            else:
                admitted.append(batch)
        return admitted

    def _defer(self, since_ns: int, batch: StepBatch, now_ns: int) -> None:
        """Let a batch wait for its declaration, as long as a missing step; without any, as in a queue."""
        if self._declared and now_ns - since_ns >= PATIENCE_NS:
            self._refuse("an env server that did not declare itself")
            return
        self._undeclared.append((since_ns, batch))
        if len(self._undeclared) > (MAX_UNDECLARED if self._declared else self._capacity):
            self._undeclared.popleft()
            self._refuse("too many batches of env servers that did not declare themselves")

    def _newest_tick(self, spec: Spec, now_ns: int) -> int:
        """The last tick that can be over by now."""
        if spec.host not in ("", self._boot):
            return 1 << 62
        slack = 0 if spec.host else SLACK_TICKS
        return max(0, now_ns - spec.t0_ns) // spec.tick_ns + slack

    def _refuse(self, why: str) -> None:
        self._bus.reject(channels.LOG, why)
