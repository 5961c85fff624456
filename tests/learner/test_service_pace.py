"""How fast the learner service learns in virtual time: under the governor, and in a hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from learner.power import Levers
from rtcore.clock import VirtualClock
from rtcore.run_dir import RunDir
from tests.learner.service_rig import CONFIG, SPEC, Rig


class Working(VirtualClock):
    """Everything takes time: a millisecond from each look at the clock to the next."""

    def now_ns(self) -> int:
        self.advance_ns(1_000_000)
        return super().now_ns()


class Machine:
    """Two cores and an arithmetic library, as the governor sees them."""

    def __init__(self) -> None:
        self.threads: list[int] = []
        self.cores: list[tuple[int, ...]] = []

    @property
    def levers(self) -> Levers:
        return Levers((0, 1), self.threads.append, lambda cores: self.cores.append(tuple(cores)))


GREEDY = replace(CONFIG, learner=replace(CONFIG.learner, utd=1000.0, threads=2))


def test_under_late_steps_it_slows_down_and_then_recovers(run_dir: RunDir) -> None:
    machine = Machine()
    rig = Rig(run_dir, GREEDY, levers=machine.levers, clock=Working(0))
    rig.specs.put(SPEC)
    rig.saturate(0, 19)
    full = rig.saturate(20, 39)
    assert (machine.threads, machine.cores) == ([1, 2], [(1,), (0, 1)])  # the second thread is earned
    pressed = rig.saturate(40, 79, late_every=2) / 2  # per 20 ticks
    assert machine.threads[2:] == [1, 1, 1, 1]
    assert machine.cores[2:] == [(1,)] * 4
    gauges = rig.ledger.stats(0).gauges
    assert (gauges["governor/threads"], gauges["governor/duty"]) == (1, 0.125)
    assert gauges["governor/load"] == 1.0
    assert pressed < full / 2
    slow = rig.saturate(80, 89) * 2
    assert slow < full / 4
    rig.saturate(90, 300)
    assert (machine.threads[-1], machine.cores[-1]) == (2, (0, 1))
    assert rig.saturate(301, 320) == pytest.approx(full, rel=0.1)
    counter = rig.ledger.counter
    assert counter("governor.decisions") == len(machine.threads) - 1
    assert counter("governor.ticks") == 321
    assert 0 < counter("governor.limited_ticks") < 321
    events = [event.text for event in rig.ledger.stats(0).events if event.text.startswith("governor: ")]
    assert events[0] == "governor: begins with 1 of 2 threads, full duty, core 1"
    assert events[1] == "governor: 2 of 2 threads, full duty: 2 s without trouble"
    assert events[2] == (
        "governor: 1 of 2 threads, full duty: p99 of the loop took 100% of the period, deadlines lost 2 times"
    )


@pytest.mark.parametrize("share", ["full", "half"])
def test_a_hold_at_half_power_pauses_half_of_the_time(run_dir: RunDir, share: str) -> None:
    learner = replace(CONFIG.learner, utd=1000.0, hold_learning=share)  # type: ignore[arg-type]
    rig = Rig(run_dir, replace(CONFIG, learner=learner), clock=Working(0))
    rig.specs.put(SPEC)
    rig.saturate(0, 9)
    update, hold = rig.saturate(10, 19), rig.saturate(21, 30)
    assert hold > 0.95 * update if share == "full" else hold < 0.7 * update


@pytest.mark.parametrize("governor", ["on", "off"])
def test_off_or_without_levers_late_steps_change_nothing(run_dir: RunDir, governor: str) -> None:
    machine = Machine()
    config = replace(CONFIG, learner=replace(CONFIG.learner, governor=governor))  # type: ignore[arg-type]
    rig = Rig(run_dir, config, levers=None if governor == "on" else machine.levers)
    rig.specs.put(SPEC)
    rig.live(0, 59, late_every=2)
    assert rig.ledger.counter("gradient_steps") == 54  # one per transition after the first five
    assert (machine.threads, machine.cores) == ([], [])
    assert not any(name.startswith("governor") for name in rig.ledger.stats(0).gauges)


def test_a_system_that_does_not_move_it_is_told_of_and_lived_with(run_dir: RunDir) -> None:
    def refuse(cores: Sequence[int]) -> None:
        raise PermissionError(f"not {cores}")

    rig = Rig(run_dir, GREEDY, levers=Levers((0, 1), lambda threads: None, refuse), clock=Working(0))
    rig.specs.put(SPEC)
    assert rig.saturate(0, 9) > 0
    events = [event.text for event in rig.ledger.stats(0).events]
    assert "governor: the learner keeps its cores: not (1,)" in events
