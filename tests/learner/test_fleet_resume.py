"""What a learner of several environments leaves to the next one, and where that goes on."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from learner import intakes
from learner.columns import MappedColumns
from learner.diary import Acted
from learner.intake import COUNTED
from learner.intakes import Intakes
from learner.place import Course, Place, Progress
from learner.replay import Replay, open_replay
from rtcore.config import ConfigError
from rtcore.ledger import Ledger
from rtcore.run_dir import RunDir
from tests.learner.fleet_rig import ENVS, FLEET, Fleet, held, spec, tick
from tests.learner.test_resume import Killed, counted, events, killed, start
from tests.learner.test_resume_disk import full


def test_the_next_learner_goes_on_in_each_log_where_the_killed_one_was(run_dir: RunDir) -> None:
    first = Fleet(run_dir)
    first.all_live(0, 9)
    first.all_live(10, 12, ["env0"])
    first.all_live(13, 14, ["env0", "env2"])  # 13 and 14 of env2 wait for those before
    second = Fleet(run_dir, at=15)
    for env, begin in zip(ENVS, (12, 8, 10), strict=True):
        second.send(env, begin, 14)
    second.all_live(15, 19)
    assert [counted(run_dir, f"learned.{env}") for env in ENVS] == [19, 19, 19]
    assert second.counts("learned") == (57 - 32, 5, 10, 10)
    assert second.counts("duplicate") == (5, 3, 2, 0)
    assert held(run_dir).added == counted(run_dir, "learned") == 57
    assert "goes on from no checkpoint: policy 1, 32 transitions in the replay" in events(second)


@pytest.mark.parametrize("where", ["before the commit", "before it counts"])
def test_killed_in_a_commit_nothing_is_learned_twice_or_lost(
    where: str, run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = Fleet(run_dir)
    first.all_live(0, 9)
    cls, name = (Replay, "commit") if where == "before the commit" else (Intakes, "_account")
    with monkeypatch.context() as patch:
        patch.setattr(cls, name, killed)
        with pytest.raises(Killed):
            first.all_live(10, 10)
    assert counted(run_dir, "learned.env1") == 9
    Fleet(run_dir, at=11).all_live(5, 14)
    assert [counted(run_dir, f"learned.{env}") for env in ENVS] == [14, 14, 14]
    assert held(run_dir).added == counted(run_dir, "learned") == 42


def test_killed_between_two_parts_of_what_came(run_dir: RunDir, monkeypatch: pytest.MonkeyPatch) -> None:
    """The env server of env1 dies after tick 5 and after tick 15; ticks 3 and 14 never come. The first part
    ends in tick 7 of each: 8 + 7 + 8 steps. So the next learner begins between the two gaps."""
    monkeypatch.setattr(intakes, "MARGIN", 23)

    def send(rig: Fleet) -> Fleet:
        for incarnation in (8, 9):
            rig.declare["env1"].put(spec("env1", incarnation=incarnation))
        for env in ("env0", "env2"):
            rig.send(env, 0, 19)
        rig.send("env1", 0, 2)
        rig.send("env1", 4, 5)
        rig.send("env1", 0, 7, incarnation=8, begin=6)
        rig.send("env1", 9, 9, incarnation=8, begin=6)
        rig.send("env1", 0, 3, incarnation=9, begin=16)
        return rig

    first = send(Fleet(run_dir, at=20))
    commits = iter([None, None])  # when it met the world, and the first part

    def commit(one: Intakes, course: Course) -> None:
        if next(commits, killed) is killed:
            raise Killed
        whole(one, course)

    whole = Intakes.commit
    with monkeypatch.context() as patch:
        patch.setattr(Intakes, "commit", commit)
        with pytest.raises(Killed):
            first.learner.catch_up()
    counts = {
        "received": (23, 8, 7, 8),
        "learned": (18, 7, 4, 7),  # of env1 1, 2, 5 and 7
        "gaps": (1, 0, 1, 0),
        "broken": (1, 0, 1, 0),
        "duplicate": (0, 0, 0, 0),
    }
    assert {name: first.counts(name) for name in COUNTED} == counts
    second = send(Fleet(run_dir, at=20))
    second.learner.catch_up()
    assert [counted(run_dir, f"learned.{env}") for env in ENVS] == [19, 13, 19]
    assert held(run_dir).added == counted(run_dir, "learned") == 19 + 13 + 19
    assert second.counts("duplicate") == (23, 8, 7, 8)
    assert (second.counts("gaps"), second.counts("broken")) == ((1, 0, 1, 0), (1, 0, 1, 0))
    assert second.counts("received") == (58, 20, 18, 20)


def test_killed_while_it_counts_the_totals_are_those_of_all(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = Fleet(run_dir)
    first.all_live(0, 9)

    def count(ledger: Ledger, name: str, number: int) -> None:
        if name == "learned":
            raise Killed
        whole(ledger, name, number)

    whole = Ledger.set_counter
    with monkeypatch.context() as patch:
        patch.setattr(Ledger, "set_counter", count)
        with pytest.raises(Killed):
            first.all_live(10, 10)
    assert first.counts("learned") == (27, 10, 10, 10)
    Fleet(run_dir, at=11).all_live(11, 14)
    assert [counted(run_dir, f"learned.{env}") for env in ENVS] == [14, 14, 14]
    assert counted(run_dir, "learned") == 42


def test_what_one_learned_in_memory_alone_is_no_debt_of_the_others(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine transitions of env0 were counted and not kept; they do not come again, five of env1 do come."""
    first = Fleet(run_dir)
    first.all_live(0, 11)
    store = first.learner.keeper._replay
    assert store is not None and store._store is not None
    with monkeypatch.context() as patch:
        patch.setattr(MappedColumns, "back", full)
        store._store._backed = 0
        first.all_live(12, 20, ["env0"])
    assert first.counts("learned") == (42, 20, 11, 11)
    second = Fleet(run_dir, at=21)
    second.send("env1", 12, 16)
    second.learner.catch_up()
    assert second.counts("learned") == (5, 0, 5, 0)


# -- the place in the logs


def note(run_dir: RunDir, data: bytes, envs: int = 3) -> None:
    """What a learner before left."""
    open_replay(run_dir.learner_dir / "replay", 1000, 2, 1, envs=envs).commit(data)


OLD = msgspec.msgpack.encode({"position": (7, 5), "previous": None, "counts": {}, "course": (0.0, -1, False)})


def test_an_older_note_is_refused_and_never_taken_as_a_beginning(run_dir: RunDir) -> None:
    note(run_dir, OLD)
    with pytest.raises(
        ConfigError, match=r"place in the log is not readable: .*missing required field `envs`"
    ):
        Fleet(run_dir).all_live(0, 0)
    fresh = replace(FLEET, learner=replace(FLEET.learner, on_mismatch="fresh"))
    rig = Fleet(run_dir, fresh)
    rig.all_live(0, 0)
    assert any(text.startswith("replay set aside as replay.set-aside-1: ") for text in events(rig))


def test_a_note_of_other_environments_is_refused(run_dir: RunDir) -> None:
    note(run_dir, Place.beginning(["env0", "env1", "other"]).encode())
    with pytest.raises(ConfigError, match=r"is of env0, env1, other \(wanted env0, env1, env2\)"):
        Fleet(run_dir).all_live(0, 0)


def test_a_replay_of_a_single_environment_is_refused(run_dir: RunDir) -> None:
    note(run_dir, Place.beginning(["env0"]).encode(), envs=1)
    with pytest.raises(ConfigError, match=r"'refuse'.*envs 1 \(wanted 3\)$"):
        Fleet(run_dir).all_live(0, 0)


def test_a_replay_of_several_is_refused_by_a_learner_of_one(run_dir: RunDir) -> None:
    note(run_dir, Place.beginning(ENVS).encode())
    with pytest.raises(ConfigError, match=r"'refuse'.*envs 3 \(wanted 1\)$"):
        start(run_dir).live(0, 0)


def test_the_places_of_16_environments_have_room(run_dir: RunDir) -> None:
    """With observations of 800 numbers, fields as long as they get in a run, and 100 policies in a unit."""
    great = 1 << 60
    last = msgspec.structs.replace(
        tick(5, "env1"), env="environment_of_a_fleet_15", incarnation=great, seq=great, tick=great,
        episode=great, unit=great, due_ns=great, woke_ns=great, sent_ns=great,
        observation=np.zeros(800, np.float32).tobytes(), action=bytes(400), decision=bytes(400),
        position=bytes(800), reward=0.1, drift=0.1, policy_version=great, fallback="neutral",
        cause="collector_pause", loop_ns=great, reaction_ns=great, late_loop_ns=great,
        late_reaction_ns=great, physics=[0.1] * 4,
    )  # fmt: skip
    acted = Acted(
        incarnation=great, next_seq=great, unit=great, ticks=dict.fromkeys(range(great, great + 100), 9)
    )
    counts = dict.fromkeys(COUNTED, great)
    progress = Progress(position=(great, great), previous=last, counts=counts, acted=acted)
    place = Place(envs={f"environment_of_a_fleet_{n}": progress for n in range(16)})
    replay = open_replay(run_dir.learner_dir / "replay", 100, 800, 100, envs=16)
    replay.commit(place.encode())
    assert replay.committed is not None
    found = Place.decode(replay.committed.note)
    assert found.counts == dict.fromkeys(COUNTED, 16 * great)
    kept = found.envs["environment_of_a_fleet_3"]
    assert (kept.position, kept.acted) == (progress.position, acted)
    assert kept.previous is not None and kept.previous.observation == last.observation
