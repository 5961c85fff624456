"""What the learner service learns from, publishes and goes on from, in virtual time."""

from __future__ import annotations

from dataclasses import replace

import pytest

from learner import meeting
from learner.place import Course
from learner.store import MARGIN
from rtcore.config import ConfigError, ScheduleConfig
from rtcore.messages import Command, StepBatch
from rtcore.run_dir import RunDir
from rtcore.spaces import Spaces
from rtcore.weights import verify
from tests.learner.service_rig import CONFIG, SPEC, TICK_NS, UNIT_NS, Rig, step


@pytest.fixture
def rig(run_dir: RunDir) -> Rig:
    rig = Rig(run_dir)
    rig.specs.put(SPEC)
    return rig


def test_it_publishes_one_iterate_a_unit_in_update_phases_only(rig: Rig) -> None:
    rig.live(0, 79)
    policies = rig.published()
    assert [(p.version, p.window, p.iterate) for p in policies] == [
        (1, 0, 1),
        (2, 0, 2),
        (3, 1, 1),
        (4, 1, 2),
    ]
    # due 0.1 s, the longest a poll can be away, before the unit ends
    assert [p.created_ns // TICK_NS for p in policies] == [9, 19, 49, 59]
    phases = [(n.message.window, n.message.phase, n.message.at_ns // UNIT_NS) for n in rig.windows.drain()]
    assert phases == [(0, "update", 0), (0, "hold", 2), (1, "update", 4), (1, "hold", 6)]
    for policy in policies:
        verify(policy, Spaces.of(SPEC))
    assert rig.ledger.counter("published_in_hold") == 0


def test_critics_go_on_learning_in_the_hold(rig: Rig) -> None:
    rig.live(0, 29)
    # 29 transitions, 5 of them before learning starts; units 0 and 1 improve the policy (14 steps)
    assert rig.ledger.counter("learned") == 29
    assert rig.ledger.counter("gradient_steps") == 24
    assert rig.ledger.counter("policy_steps") == 14


def test_everything_that_waits_before_the_spec_is_learned_after_it(run_dir: RunDir) -> None:
    rig = Rig(run_dir)
    rig.live(0, 9)
    assert rig.ledger.counter("learned") == 0
    rig.specs.put(SPEC)
    rig.live(10, 10)
    assert rig.ledger.counter("learned") == 10


def test_a_repeated_and_a_lost_batch_are_counted(rig: Rig) -> None:
    rig.live(0, 9)
    rig.live(5, 9)
    rig.live(12, 20)  # 10 and 11 are lost
    rig.clock.advance_ns(6 * UNIT_NS)
    rig.learner.catch_up()
    assert (rig.ledger.counter("duplicate"), rig.ledger.counter("gaps")) == (5, 2)
    assert rig.ledger.counter("broken") == 1  # step 12 has no predecessor
    assert rig.ledger.counter("learned") == 9 + 8


def test_an_operators_hold_withholds_and_resume_publishes_again(run_dir: RunDir) -> None:
    always = replace(CONFIG.learner, schedule=ScheduleConfig(l_f=4, gamma_f=1.0))
    rig = Rig(run_dir, replace(CONFIG, learner=always))
    rig.specs.put(SPEC)
    rig.live(0, 12)
    assert rig.order("hold") == "the policy will be held"
    rig.live(13, 32)
    assert [p.created_ns // TICK_NS for p in rig.published()] == [9]
    assert rig.ledger.counter("withheld") == 1  # in the unit in which the order came
    rig.order("resume")
    rig.live(33, 39)
    assert [p.created_ns // TICK_NS for p in rig.published()] == [39]
    reasons = [(n.message.phase, n.message.reason) for n in rig.windows.drain()]
    assert reasons == [("update", "schedule"), ("hold", "operator"), ("update", "operator")]


def test_a_second_learner_of_the_run_goes_on_from_the_checkpoint(rig: Rig, run_dir: RunDir) -> None:
    rig.live(0, 19)
    rig.learner.close()
    second = Rig(run_dir)
    second.specs.put(SPEC)
    second.live(15, 59)  # the log repeats what its cache holds
    assert second.ledger.counter("learned") == 40  # 20..59; nothing is learned twice, nothing left out
    assert second.ledger.counter("duplicate") == 5
    assert [p.version for p in second.published()] == [2, 3, 4]  # the newest once more, then its own
    assert second.ledger.counter("gradient_steps") == 40  # it has data: it does not wait again
    events = [event.text for event in second.ledger.stats(0).events]
    assert "goes on from the checkpoint: policy 2, 19 transitions in the replay" in events


def test_an_order_in_the_turn_of_a_publication_comes_first(rig: Rig) -> None:
    rig.live(0, 8)
    rig.order("hold")
    rig.live(9, 9)  # iterate 1 is due here
    assert rig.published() == []
    assert rig.ledger.counter("withheld") == 1


def test_a_checkpoint_of_another_network_is_refused(rig: Rig, run_dir: RunDir) -> None:
    rig.live(0, 19)
    rig.learner.close()
    other = Rig(run_dir, replace(CONFIG, learner=replace(CONFIG.learner, hidden=(8, 4))))
    other.specs.put(SPEC)
    with pytest.raises(ConfigError, match=r"learner.on_mismatch = 'refuse': .*8, 4"):
        other.live(20, 21)


def test_after_the_duration_nothing_begins(run_dir: RunDir) -> None:
    rig = Rig(run_dir, replace(CONFIG, duration_s=4.0))
    rig.specs.put(SPEC)
    rig.live(0, 39)
    done = rig.ledger.counter("gradient_steps")
    rig.live(40, 45)  # taken in, but nothing is learned from it any more
    assert rig.ledger.counter("learned") == 45
    assert rig.ledger.counter("gradient_steps") == done
    assert [n.message.window for n in rig.windows.drain()] == [0, 0]


def test_an_unknown_order_is_refused(rig: Rig) -> None:
    reply = rig.learner.command(Command(id="1", verb="stop"))
    assert not reply.ok and "stop" in reply.text


def test_it_shows_that_it_lives_within_a_turn_that_takes_long(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint that takes 7 s to load, then three parts of a backlog, of which each takes 5 s."""
    meet, commit, beats = meeting.meet, rig.learner._intake.commit, list[float]()

    def slow_meet(*given: object) -> meeting.Beginning:
        rig.clock.advance_ns(7_000_000_000)
        return meet(*given)  # type: ignore[arg-type]

    def slow_commit(course: Course) -> None:
        rig.clock.advance_ns(5_000_000_000)
        commit(course)

    monkeypatch.setattr(meeting, "meet", slow_meet)
    monkeypatch.setattr(rig.learner._intake, "commit", slow_commit)
    monkeypatch.setattr(rig.ledger, "beat", lambda now_ns: beats.append(now_ns / 1e9))
    rig.clock.sleep_until_ns(300_000_000_000)
    rig.log.put(StepBatch(steps=[step(seq, reset=seq == 0) for seq in range(2 * MARGIN + 1)]))
    rig.learner._take_in()
    assert beats == [307, 317, 322, 327]  # it commits once when it has met the world
