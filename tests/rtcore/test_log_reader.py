"""Whose steps a reader of the log takes: of env servers that declared themselves, and of the past."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.epoch import this_boot
from rtcore.log_reader import LogReader
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Spec, Step, StepBatch
from tests.rtcore.bus_samples import ENV, spec
from tests.rtcore.steps import make_step

SECOND = 1_000_000_000
SPEC: Spec = replace(spec(), t0_ns=0, tick_ns=50_000_000)


class Rig:
    """A reader on a virtual clock, and what speaks to it."""

    def __init__(self) -> None:
        hub, self.clock = MemoryHub(), VirtualClock(10 * SECOND)
        self.bus, other = hub.bus("learner", self.clock), hub.bus("env_server", self.clock)
        self.specs, self.log = other.publisher(channels.SPEC, ENV), other.publisher(channels.LOG, ENV)
        self.reader = LogReader(self.bus, ENV, capacity_batches=10)

    def read(self, *steps: Step) -> list[tuple[int, int]]:
        """What the reader hands out after these came: (incarnation, seq)."""
        if steps:
            self.log.put(StepBatch(steps=list(steps)))
        return [(step.incarnation, step.seq) for step in self.reader.read(self.clock.now_ns())]


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_a_batch_waits_for_the_declaration_of_its_env_server(rig: Rig) -> None:
    assert rig.read(make_step(0)) == []
    rig.clock.advance_ns(60 * SECOND)  # nobody has declared itself: nothing is known to be wrong
    rig.specs.put(SPEC)
    assert rig.read(make_step(1)) == [(1, 0), (1, 1)]
    assert rig.read(make_step(0, incarnation=2)) == []
    rig.specs.put(replace(SPEC, incarnation=2))
    assert rig.read() == [(2, 0)]
    assert rig.bus.rejected() == {}


def test_what_nobody_declares_does_not_end_the_true_stream(rig: Rig) -> None:
    rig.specs.put(SPEC)
    assert rig.read(make_step(0)) == [(1, 0)]
    assert rig.read(make_step(0, incarnation=1 << 60)) == []
    assert rig.read(make_step(1)) == [(1, 1)]
    rig.clock.advance_ns(5 * SECOND)
    assert rig.read(make_step(2)) == [(1, 2)]
    assert rig.bus.rejected() == {"log": 1}


def test_a_flood_of_undeclared_batches_has_bounded_room(rig: Rig) -> None:
    rig.specs.put(SPEC)
    for number in range(300):
        assert rig.read(make_step(0, incarnation=1000 + number)) == []
    assert rig.bus.rejected() == {"log": 300 - 256}
    rig.reader.finish()
    assert rig.bus.rejected() == {"log": 300}


def test_a_declaration_of_another_world_is_none(rig: Rig) -> None:
    rig.specs.put(SPEC)
    rig.specs.put(replace(SPEC, incarnation=9, observation_dim=5))
    assert rig.read(make_step(0)) == [(1, 0)]
    assert rig.read(make_step(0, incarnation=9)) == []
    assert rig.bus.rejected() == {"spec": 1}


@pytest.mark.parametrize(("ours", "allowed"), [(True, 200), (False, 1200)])
def test_a_step_of_the_future_is_refused(rig: Rig, ours: bool, allowed: int) -> None:
    """10 s of 50 ms: tick 200 is due now; without a host 1000 more are let through."""
    rig.specs.put(replace(SPEC, host=this_boot() if ours else ""))
    assert rig.read(make_step(0)) == [(1, 0)]
    rig.read(make_step(5, tick=allowed + 1))
    rig.read(make_step(5, tick=10**12))
    assert rig.reader.stream.received == 1
    assert rig.read(*(make_step(seq) for seq in range(1, 5)), make_step(5, tick=allowed))[-1] == (1, 5)
    assert rig.bus.rejected() == {"log": 2}


def test_what_comes_after_the_clock_was_looked_at_is_not_of_the_future(rig: Rig) -> None:
    rig.specs.put(replace(SPEC, host=this_boot()))
    looked_ns = rig.clock.now_ns()  # 10 s: tick 200 is over, and 201 is not
    rig.clock.advance_ns(SECOND // 20)
    rig.log.put(StepBatch(steps=[make_step(0, tick=201)]))
    assert [step.tick for step in rig.reader.read(looked_ns)] == [201]
    assert rig.bus.rejected() == {}


def test_another_hosts_clock_tells_nothing_of_the_future(rig: Rig) -> None:
    rig.specs.put(replace(SPEC, host="elsewhere"))
    assert rig.read(make_step(0, tick=10**9)) == [(1, 0)]


def test_the_world_is_what_the_caller_expects_whoever_declared_itself_first(rig: Rig) -> None:
    foreign = replace(SPEC, incarnation=7, tick_ns=1)
    rig.specs.put(foreign)
    assert rig.read(make_step(0, incarnation=7)) == [(7, 0)]
    rig.specs.put(SPEC)
    rig.read()
    assert rig.bus.rejected() == {"spec": 1}
    other = Rig()
    other.specs.put(foreign)
    other.read()
    other.reader.expect(SPEC)
    other.specs.put(SPEC)
    assert other.read(make_step(0)) == [(1, 0)]
    other.specs.put(foreign)
    other.read()
    assert other.bus.rejected() == {"spec": 2}


def test_declarations_are_bounded_and_the_first_one_stays(rig: Rig) -> None:
    rig.specs.put(SPEC)
    for incarnation in range(2, 400):
        rig.specs.put(replace(SPEC, incarnation=incarnation))
        rig.read()
    assert rig.read(make_step(0)) == [(1, 0)]
    assert rig.read(make_step(0, incarnation=399)) == [(399, 0)]
