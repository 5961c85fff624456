"""A learner's checkpoints while it learns, and what a disk that fails costs it and the next one."""

from __future__ import annotations

import errno

import pytest

from learner import checkpoint
from learner.columns import MappedColumns
from learner.replay import Replay
from learner.store import Store
from rtcore.run_dir import RunDir
from tests.learner.test_resume import config, counted, events, held, start


def full(*_: object) -> int:
    """In place of what takes room on a disk."""
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_checkpoint_comes_when_a_unit_ends_and_it_is_time(run_dir: RunDir) -> None:
    rig, written = start(run_dir, config(checkpoint_s=1.5)), list[int]()
    for tick in range(60):
        rig.live(tick, tick)
        rig.learner.keeper.flush()
        if rig.ledger.counter("checkpoints") > len(written):
            written.append(tick)
    assert written == [10, 30, 50]  # the first at once, then every other unit is over too early


def test_while_one_checkpoint_waits_no_other_is_copied(run_dir: RunDir) -> None:
    rig = start(run_dir)
    rig.live(0, 59)
    assert rig.learner.keeper._waiting.qsize() == 1
    rig.learner.close()
    rig.learner.keeper.flush()  # what waited is older than the last, and is not written over it
    saved = checkpoint.load(run_dir.learner_dir / "checkpoint").scalars
    assert saved["gradient_steps"] == rig.ledger.counter("gradient_steps")


def test_a_unit_longer_than_the_period_does_not_put_checkpoints_off(run_dir: RunDir) -> None:
    rig = start(run_dir, config(checkpoint_s=0.35))
    written = []
    for tick in range(9):
        rig.live(tick, tick)
        rig.learner.keeper.flush()
        written.append(rig.ledger.counter("checkpoints"))
    assert written == [1, 1, 1, 1, 2, 2, 2, 2, 3]


def test_a_disk_that_takes_no_checkpoint_is_counted_and_said_once(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = start(run_dir)
    rig.live(0, 10)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "write_atomic", full)
        for unit in (1, 2, 3):
            rig.learner.keeper.flush()
            rig.live(10 * unit + 1, 10 * unit + 10)
    rig.learner.keeper.flush()
    assert (rig.ledger.counter("checkpoint.errors"), rig.ledger.counter("checkpoints")) == (3, 1)
    assert [text for text in events(rig) if "no checkpoint" in text] == [
        "no checkpoint: [Errno 28] No space left on device"
    ]


def test_a_disk_that_takes_no_replay_costs_what_comes_then_and_no_more(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = start(run_dir)
    rig.live(0, 11)
    rig.learner.keeper.flush()
    monkeypatch.setattr(MappedColumns, "back", full)
    store = rig.learner.keeper._replay
    assert store is not None and store._store is not None
    store._store._backed = 0  # as if a chunk ended here
    rig.live(12, 39)
    rig.learner.close()
    assert rig.ledger.counter("replay.unbacked") == 28
    assert rig.ledger.counter("gradient_steps") == 34  # it learns from them all the same
    assert any("no checkpoint is written any more: [Errno 28]" in text for text in events(rig))
    monkeypatch.undo()
    assert held(run_dir).added == 11
    second = start(run_dir, at=40)
    second.live(12, 45)  # the checkpoint is none that knows more than the replay
    assert held(run_dir).added == 45
    assert counted(run_dir, "learned") == 45  # 12 to 39, which came twice, once


def test_what_was_learned_in_memory_alone_and_never_comes_again_is_a_gap(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    """0 to 11 in files, 12 to 20 in memory, 30 to 45 by the next; 30 follows none. The run has learned
    what its replay was given, 1 to 11 and 31 to 45: with what it lost and could not use, all 45."""
    rig = start(run_dir)
    rig.live(0, 11)
    store = rig.learner.keeper._replay
    assert store is not None and store._store is not None
    with monkeypatch.context() as patch:
        patch.setattr(MappedColumns, "back", full)
        store._store._backed = 0
        rig.live(12, 20)
    assert counted(run_dir, "learned") == 20
    second = start(run_dir, at=29)
    second.live(30, 45)
    second.learner.close()
    assert (held(run_dir).added, counted(run_dir, "learned")) == (26, 26)
    assert (counted(run_dir, "gaps"), counted(run_dir, "broken")) == (18, 1)


def test_a_replay_that_the_disk_does_not_give_back_is_gone_on_from_where_it_ended(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    start(run_dir).live(0, 19)
    with monkeypatch.context() as patch:
        patch.setattr(Store, "open", fail)
        second = start(run_dir, at=20)
        second.live(10, 29)
    assert (second.learner._intake.replay_size, counted(run_dir, "learned")) == (10, 29)  # 20 to 29
    start(run_dir, at=30).live(10, 35)
    assert (held(run_dir).added, counted(run_dir, "learned")) == (35, 35)


def test_a_copy_that_waited_when_the_disk_failed_is_not_written(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = start(run_dir)
    rig.live(0, 11)  # the copy of tick 10 waits
    monkeypatch.setattr(MappedColumns, "back", full)
    found = rig.learner.keeper._replay
    assert found is not None and found._store is not None
    found._store._backed = 0
    rig.live(12, 12)
    rig.learner.keeper.flush()
    assert (rig.ledger.counter("checkpoints"), rig.ledger.counter("checkpoint.errors")) == (0, 1)
    assert not checkpoint.exists(run_dir.learner_dir / "checkpoint")


def test_what_a_killed_learner_was_writing_is_removed(run_dir: RunDir) -> None:
    """A state of 20 MB has another name each time: nothing would ever replace it."""
    first = start(run_dir)
    first.live(0, 19)
    first.learner.close()
    folder = run_dir.learner_dir
    left = [folder / ".policy.msgpack.1-2.tmp", folder / "checkpoint/.state-1.1-2.tmp"]
    left.append(folder / "replay/.synced.bin.1-2.tmp")
    for path in left:
        path.write_bytes(b"half")
    start(run_dir, at=20).live(20, 20)
    assert not any(path.exists() for path in left)


def test_the_checkpoint_is_never_newer_than_the_replay_that_the_disk_has(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For the case that the host ends: first the rows and their record, then the checkpoint."""
    order: list[str] = []
    monkeypatch.setattr(Replay, "sync", lambda self, record, last=False: order.append("replay"))
    monkeypatch.setattr(checkpoint, "save", lambda directory, state: order.append("checkpoint"))
    rig = start(run_dir)
    rig.live(0, 10)
    rig.learner.keeper.flush()
    assert order == ["replay", "checkpoint"]
