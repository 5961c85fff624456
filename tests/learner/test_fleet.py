"""A learner of several environments, in virtual time."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from learner import intake, intakes
from learner.intake import COUNTED
from learner.power import Levers
from rtcore.bus import Bus
from rtcore.clock import VirtualClock
from rtcore.log_reader import LogReader
from rtcore.messages import StepBatch
from rtcore.run_dir import RunDir
from tests.learner.fleet_rig import ENVS, FLEET, SECOND, Fleet, held, spec, tick
from tests.learner.service_rig import CONFIG, SPEC, TICK_NS, Rig
from tests.learner.test_resume import events


def test_it_learns_from_all(run_dir: RunDir) -> None:
    rig = Fleet(run_dir)
    rig.all_live(0, 19)
    assert rig.counts("learned") == (57, 19, 19, 19)
    assert rig.counts("received") == (60, 20, 20, 20)
    assert rig.ledger.counter("gradient_steps") == 52  # as many as transitions after the first 5
    assert [(p.version, p.created_ns // TICK_NS) for p in rig.published()] == [(1, 9), (2, 19)]


def test_of_one_environment_nothing_is_counted_twice(run_dir: RunDir) -> None:
    rig = Rig(run_dir)
    rig.specs.put(SPEC)
    rig.live(0, 5)
    assert not [name for name in rig.ledger.stats(0).counters if "env" in name or "raised" in name]


def test_units_rise_although_a_lot_comes_of_one_after_the_other(run_dir: RunDir) -> None:
    """Four seconds of each at once, as after a restart; the transitions of each stay in order."""
    rig = Fleet(run_dir, at=40)
    for env in ENVS:
        rig.send(env, 0, 39)
    rig.learner.catch_up()
    replay = held(run_dir)
    rows = replay.read(0, 1000)
    assert [int((rows.reward == env).sum()) for env in range(3)] == [39, 39, 39]
    for number in range(3):
        assert rows.next_observation[rows.reward == number, 0].tolist() == list(range(1, 40))
        assert rows.unit[rows.reward == number].tolist() == [seq // SECOND for seq in range(1, 40)]
    assert all(a <= b for a, b in pairwise(rows.unit.tolist()))


def test_whichever_declares_itself_first_begins_and_the_others_wait_for_their_own(run_dir: RunDir) -> None:
    rig = Fleet(run_dir, declare=["env1"])
    rig.all_live(0, 9)
    assert rig.counts("learned") == (9, 0, 9, 0)
    rig.declare["env0"].put(spec("env0"))
    rig.all_live(10, 10)
    assert rig.counts("learned") == (20, 10, 10, 0)  # with all that had come before
    rig.declare["env2"].put(spec("env2"))
    rig.learner.catch_up()
    assert rig.counts("learned") == (30, 10, 10, 10)
    assert (rig.counts("gaps"), rig.counts("broken")) == ((0,) * 4, (0,) * 4)
    assert not [text for text in events(rig) if "came back" in text]


def test_one_comes_back_while_the_others_go_on(run_dir: RunDir) -> None:
    rig = Fleet(run_dir)
    rig.all_live(0, 9)
    rig.all_live(10, 12, ["env0", "env2"])
    rig.declare["env1"].put(spec("env1", incarnation=8))
    for seq in range(13, 20):
        rig.clock.sleep_until_ns(seq * TICK_NS)
        rig.send("env1", seq - 13, seq - 13, incarnation=8, begin=13)
        rig.send("env0", seq, seq)
        rig.send("env2", seq, seq)
        rig.learner.catch_up()
    assert rig.counts("learned") == (19 + 15 + 19, 19, 9 + 6, 19)
    assert (rig.counts("gaps"), rig.counts("broken")) == ((0,) * 4, (0,) * 4)
    told = [text for text in events(rig) if "came back" in text]
    assert told == ["the env server of env1 came back; units and windows go on by its first clock"]
    assert rig.ledger.counter("replay.raised") == 0


def test_what_comes_when_another_is_in_a_later_unit_is_filed_there_and_counted(run_dir: RunDir) -> None:
    """Ticks 5 to 12 of each in a batch, taken in one after the other; unit 1 begins with tick 10. So 5 to 9
    of env1 come after tick 12 of env0, and those of env2 likewise."""
    rig = Fleet(run_dir)
    rig.all_live(0, 4)
    rig.clock.sleep_until_ns(12 * TICK_NS)
    for env in ENVS:
        rig.send(env, 5, 12)
        rig.learner.catch_up()
    assert rig.ledger.counter("replay.raised") == 10
    rows = held(run_dir).read(0, 1000)
    in_unit_0 = [int(((rows.reward == env) & (rows.unit == 0)).sum()) for env in range(3)]
    assert in_unit_0 == [9, 4, 4]
    assert rig.counts("learned") == (36, 12, 12, 12)


@pytest.mark.parametrize("first", ENVS)
def test_units_and_windows_are_the_runs_whichever_declares_itself_first(first: str, run_dir: RunDir) -> None:
    """Each has a T0 of its own, a third of a tick after that of the one before."""
    rig = Fleet(run_dir, declare=[first])
    rig.all_live(0, 22)
    second = Fleet(run_dir, at=23, declare=[first])
    second.all_live(23, 45)
    for one, begins in ((rig, [0, 20]), (second, [23, 40])):  # the second comes in the middle of a hold
        notices = [received.message for received in one.windows.drain()]
        assert [notice.at_ns for notice in notices] == [begin * TICK_NS for begin in begins]


def test_a_gap_in_one_does_not_hold_up_the_others(run_dir: RunDir) -> None:
    rig = Fleet(run_dir)
    rig.all_live(0, 9)
    rig.all_live(10, 11, ["env0", "env2"])  # those of env1 are lost
    rig.all_live(12, 40)
    assert rig.counts("learned") == (40 + 9 + 40, 40, 9, 40)
    rig.until(7.0)
    assert rig.counts("learned") == (40 + 37 + 40, 40, 37, 40)
    assert (rig.counts("gaps"), rig.counts("broken")) == ((2, 0, 2, 0), (1, 0, 1, 0))  # 12 follows none


def test_the_counters_of_each_add_up(run_dir: RunDir) -> None:
    """Batches get lost, come twice and late at random; one env server comes back."""
    rig, rng = Fleet(run_dir), np.random.default_rng(1)
    for first in range(0, 120, 3):
        rig.clock.sleep_until_ns((first + 3) * TICK_NS)
        if first == 60:
            rig.declare["env2"].put(spec("env2", incarnation=8))
        for env in ENVS:
            again = env == "env2" and first >= 60
            begin = 60 if again else 0
            sent = ([first], [first], [], [first, first], [first - 3, first])[rng.integers(5)]
            for at in (part - begin for part in ([first] if first == begin else sent)):
                rig.send(env, at, at + 2, incarnation=7 + again, begin=begin)
        rig.learner.catch_up()
    rig.learner.close()
    assert min(min(rig.counts(name)) for name in COUNTED) > 0
    for name in COUNTED:
        total, *each = rig.counts(name)
        assert total == sum(each), name
    for env, resets in zip(ENVS, (1, 1, 2), strict=True):
        count = {name: rig.ledger.counter(f"{name}.{env}") for name in COUNTED}
        delivered = count["received"] - count["duplicate"]
        assert delivered == count["learned"] + count["broken"] + resets
        assert delivered + count["gaps"] <= 120  # what was lost at an end is in no gap
    rows = held(run_dir).read(0, 1000)
    assert [int((rows.reward == env).sum()) for env in range(3)] == list(rig.counts("learned")[1:])


def test_late_ticks_of_one_slow_the_learner_down(run_dir: RunDir) -> None:
    """Each look at the clock takes a millisecond, so the learner works all the time."""

    class Working(VirtualClock):
        def now_ns(self) -> int:
            self.advance_ns(1_000_000)
            return super().now_ns()

    greedy = replace(FLEET, learner=replace(FLEET.learner, utd=1000.0))
    threads: list[int] = []
    levers = Levers((0, 1), threads.append, lambda cores: None)
    rig = Fleet(run_dir, greedy, levers=levers, clock=Working(0))
    for seq in range(40):
        rig.clock.sleep_until_ns(seq * TICK_NS)
        for env in ENVS:
            rig.logs[env].put(StepBatch(steps=[tick(seq, env, late=env == "env1" and seq % 2 == 1)]))
        while rig.clock.now_ns() < (seq + 1) * TICK_NS - 15_000_000:
            rig.learner.step()
    rig.learner._report(rig.learner._algorithm)  # type: ignore[arg-type]
    gauges = rig.ledger.stats(0).gauges
    assert (gauges["governor/threads"], gauges["governor/duty"]) == (1, 0.125)
    assert rig.ledger.counter("governor.ticks") == 120


# -- another task


def test_an_environment_of_another_task_is_refused_for_good(run_dir: RunDir) -> None:
    rig = Fleet(run_dir, declare=["env0", "env1"])
    rig.declare["env2"].put(spec("env2", unit_ns=2 * SPEC.unit_ns))
    rig.all_live(0, 9)
    rig.declare["env2"].put(spec("env2", incarnation=8, action_low=[-1.0]))
    rig.all_live(10, 14)
    assert rig.learner._intake._bus.rejected() == {"spec": 2}
    rig.declare["env2"].put(spec("env2", incarnation=9))  # its log has steps of the other task
    rig.all_live(15, 19)
    assert rig.learner._intake._bus.rejected() == {"spec": 3}
    assert rig.counts("learned") == (38, 19, 19, 0)
    told = [text for text in events(rig) if "env2" in text]
    assert told == [
        "nothing is learned from env2, another task than env0: unit_ns = 2000000000: the world has 1000000000"
    ]
    assert rig.ledger.counter("refused.env2") == 20
    for env in ("env0", "env1"):
        rig.logs[env].put(StepBatch(steps=[], last=True))
    rig.learner.catch_up()
    assert rig.learner._intake.ended


def test_what_a_refused_environment_sends_does_not_pile_up(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is room for ten batches of each."""
    monkeypatch.setattr(intakes, "CAPACITY_BATCHES", 30)
    monkeypatch.setattr(intakes, "LEAST_BATCHES", 10)
    rig = Fleet(run_dir, declare=["env0", "env1"])
    rig.all_live(0, 4)  # nobody knows yet what env2 is
    rig.declare["env2"].put(spec("env2", unit_ns=2 * SPEC.unit_ns))
    rig.all_live(5, 29)
    assert rig.learner._intake._bus.rejected() == {"spec": 1}
    assert rig.ledger.counter("refused.env2") == 30
    assert rig.counts("received") == (60, 30, 30, 0)


def test_it_ends_when_all_have_ended(run_dir: RunDir) -> None:
    rig = Fleet(run_dir)
    rig.all_live(0, 9)
    for env in ENVS:
        assert not rig.learner._intake.ended
        rig.logs[env].put(StepBatch(steps=[tick(10, env)], last=True))
        rig.learner.catch_up()
    assert rig.learner._intake.ended
    assert rig.counts("learned") == (30, 10, 10, 10)


# -- waiting


def test_it_waits_for_one_that_goes_on(run_dir: RunDir) -> None:
    """In virtual time a wait takes all of its time where nothing is there. env1 has something that must not
    end the wait, since nobody takes it before env1 has declared itself."""
    rig = Fleet(run_dir, declare=["env0", "env2"])
    rig.all_live(0, 9)
    rig.send("env1", 10, 10)

    def waited() -> int:
        begin = rig.clock.now_ns()
        rig.learner._intake.wait(0.25)
        return rig.clock.now_ns() - begin

    assert waited() == 250_000_000
    rig.send("env0", 10, 10)
    assert waited() == 0
    rig.logs["env0"].put(StepBatch(steps=[], last=True))
    rig.learner.catch_up()
    rig.send("env2", 10, 10)
    assert waited() == 0  # env0 has ended
    rig.learner.catch_up()
    assert waited() == 250_000_000


@pytest.mark.parametrize(("count", "each"), [(1, 20_000), (4, 5_000), (8, 2_500), (16, 2_500)])
def test_a_fleet_shares_the_room_for_what_waits(
    count: int, each: int, run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    capacities: list[int] = []

    def reader(bus: Bus, env: str, *, capacity_batches: int) -> LogReader:
        capacities.append(capacity_batches)
        return LogReader(bus, env, capacity_batches=capacity_batches)

    monkeypatch.setattr(intake, "LogReader", reader)
    Rig(run_dir, replace(CONFIG, env=replace(CONFIG.env, count=count)))
    assert capacities == [each] * count
