"""A replay in files: what was committed is there again, whatever ended: the process, the host, the disk."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learner import store
from learner.columns import MappedColumns
from learner.marks import Marks
from learner.replay import Replay, ReplayError, make_batch, open_replay
from learner.store import MARGIN


def add(replay: Replay, number: int, unit: int | None = None) -> None:
    """A transition whose every field says its number."""
    value = np.array([number, -number], np.float32)
    replay.add(value, value[:1], float(number), value + 1, number % 2 == 1, number if unit is None else unit)


def live(replay: Replay, first: int, last: int) -> None:
    """Numbers first..last, committed one by one."""
    for number in range(first, last + 1):
        add(replay, number)
        replay.commit(b"%d" % number)


def reopened(directory: Path, capacity: int = 4, boot: str = "boot") -> Replay:
    return open_replay(directory, capacity, 2, 1, boot=boot)


def held(replay: Replay) -> list[float]:
    numbers: list[float] = replay.read(0, 99_999).reward.tolist()
    return numbers


def note(replay: Replay) -> bytes:
    assert replay.committed is not None
    return replay.committed.note


def test_what_was_committed_comes_back_and_the_rest_does_not(tmp_path: Path) -> None:
    replay = reopened(tmp_path / "replay")
    live(replay, 0, 5)
    for number in (6, 7, 8):
        add(replay, number)
    again = reopened(tmp_path / "replay")  # nothing was flushed or closed
    assert (held(again), again.added, len(again), note(again)) == ([2, 3, 4, 5], 6, 4, b"5")
    live(again, 6, 6)
    assert held(reopened(tmp_path / "replay")) == [3, 4, 5, 6]


@settings(max_examples=30, deadline=None)
@given(
    capacity=st.integers(1, 9),
    lives=st.lists(st.lists(st.integers(0, 6), min_size=1, max_size=4), min_size=1, max_size=5),
    margin=st.integers(6, 8),
)
def test_killed_lives_and_a_straight_one_hold_the_same(
    tmp_path_factory: pytest.TempPathFactory, capacity: int, lives: list[list[int]], margin: int
) -> None:
    """Each life commits some batches and is killed in the middle of the last one."""
    directory, straight = tmp_path_factory.mktemp("replay"), Replay(capacity, 2, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "MARGIN", margin)  # so that the ring wraps
        for batches in lives:
            replay = reopened(directory, capacity)
            assert replay.content_hash() == straight.content_hash()
            for size in batches[:-1]:
                for number in range(replay.added, replay.added + size):
                    add(replay, number, number // 3)
                    add(straight, number, number // 3)
                replay.commit(b"")
                for unit in range(replay.added // 3 + 1):
                    assert replay.count_since(unit) == straight.count_since(unit)
                if len(straight):
                    drawn, wanted = make_batch(20, 2, 1), make_batch(20, 2, 1)
                    for recency in (None, 1.5):
                        replay.sample(np.random.default_rng(0), drawn, None, recency)
                        straight.sample(np.random.default_rng(0), wanted, None, recency)
                        assert drawn.reward.tolist() == wanted.reward.tolist()
                        assert replay.mean_unit(None, recency) == straight.mean_unit(None, recency)
            for number in range(replay.added, replay.added + batches[-1]):
                add(replay, number, number // 3)


def test_more_than_the_margin_is_not_taken_uncommitted(tmp_path: Path) -> None:
    replay = reopened(tmp_path)
    for number in range(MARGIN):
        add(replay, number)
    with pytest.raises(RuntimeError, match="1024 transitions added and not committed"):
        add(replay, MARGIN)


def test_a_replay_of_another_shape_is_refused_and_stays(tmp_path: Path) -> None:
    live(reopened(tmp_path), 0, 2)
    with pytest.raises(ReplayError, match=r"capacity 4 \(wanted 8\), observation_dim 2 \(wanted 3\)$"):
        open_replay(tmp_path, 8, 3, 1)
    assert held(reopened(tmp_path)) == [0, 1, 2]


def test_an_older_version_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cursor.json").write_text("{}")
    with pytest.raises(ReplayError, match=r"schema 2 or older \(wanted 4\)"):
        reopened(tmp_path)


def test_a_replay_of_one_environment_without_a_name_is_refused(tmp_path: Path) -> None:
    """As version 3 had it, which fits in all else."""
    shape = {"schema": 3, "capacity": 4, "observation_dim": 2, "action_dim": 1}
    Marks.open(tmp_path / "marks.bin", shape, 4096 + 4 * 2)
    with pytest.raises(ReplayError, match=r"schema 3 \(wanted 4\)$"):
        reopened(tmp_path)


def test_a_damaged_replay_is_refused(tmp_path: Path) -> None:
    live(reopened(tmp_path), 0, 2)
    reward = tmp_path / "reward.bin"
    whole = reward.read_bytes()
    reward.write_bytes(whole[:-1])
    with pytest.raises(ReplayError, match=r"reward\.bin: 4111 bytes \(wanted 4112\)"):
        reopened(tmp_path)
    reward.unlink()
    with pytest.raises(ReplayError, match=r"reward\.bin: missing"):
        reopened(tmp_path)
    (tmp_path / "marks.bin").unlink()
    with pytest.raises(ReplayError, match=r"marks\.bin: missing"):
        reopened(tmp_path)


def test_a_learner_killed_while_it_made_the_files_leaves_a_usable_directory(tmp_path: Path) -> None:
    reopened(tmp_path)
    (tmp_path / "unit.bin").unlink()
    live(reopened(tmp_path), 0, 1)
    assert held(reopened(tmp_path)) == [0, 1]


# -- the host ends


def test_after_a_crash_of_the_host_what_was_synced_counts(tmp_path: Path) -> None:
    replay = reopened(tmp_path, 2000)
    live(replay, 0, 9)
    assert replay.committed is not None
    replay.sync(replay.committed)
    live(replay, 10, 14)
    again = reopened(tmp_path, 2000, boot="next")
    assert (held(again), note(again)) == (list(range(10)), b"9")
    live(again, 10, 10)
    assert held(reopened(tmp_path, 2000, boot="next")) == list(range(11))


def test_after_a_crash_of_the_host_nothing_counts_that_may_be_written_over(tmp_path: Path) -> None:
    """A ring of 4 + 1024 rows of which 1024 are reserved: of the 4 held at the sync, none may be written over
    before the 1025th row after it; with 2 rows less in the ring, the oldest 2 may."""
    replay = reopened(tmp_path)
    live(replay, 0, 1999)
    assert replay.committed is not None
    replay.sync(replay.committed)
    live(replay, 2000, 2500)
    assert held(reopened(tmp_path, boot="next")) == [1996, 1997, 1998, 1999]
    synced = store._read(tmp_path / "synced.bin")
    assert synced is not None and synced.until == 3024
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "MARGIN", MARGIN - 2)
        assert store._after_a_crash(synced, 4, "next").oldest == 1998


def test_a_crash_of_the_host_before_anything_was_synced_leaves_nothing(tmp_path: Path) -> None:
    live(reopened(tmp_path), 0, 5)
    again = reopened(tmp_path, boot="next")
    assert (held(again), again.added, note(again)) == ([], 0, b"")


def test_an_orderly_end_loses_nothing_to_a_restart_of_the_host(tmp_path: Path) -> None:
    replay = reopened(tmp_path)
    live(replay, 0, 1500)
    assert replay.committed is not None
    replay.sync(replay.committed, last=True)
    assert held(reopened(tmp_path, boot="next")) == [1497, 1498, 1499, 1500]


def test_what_was_reserved_is_synced_anew_before_it_is_passed(tmp_path: Path) -> None:
    replay = reopened(tmp_path)
    live(replay, 0, 9)
    assert replay.committed is not None
    replay.sync(replay.committed)  # reserves up to number 1034
    live(replay, 10, 1500)
    again = reopened(tmp_path, boot="next")
    assert again.added == 1034
    assert held(again) == [1030, 1031, 1032, 1033]


def test_an_older_record_does_not_replace_a_newer_one_on_the_disk(tmp_path: Path) -> None:
    replay = reopened(tmp_path)
    live(replay, 0, 4)
    older = replay.committed
    live(replay, 5, 9)
    assert older is not None and replay.committed is not None
    replay.sync(replay.committed)
    replay.sync(older)
    assert reopened(tmp_path, boot="next").added == 10


# -- the disk is full


def test_a_disk_that_fills_up_leaves_it_in_memory_and_the_files_as_committed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay = reopened(tmp_path)
    live(replay, 0, 1025)
    add(replay, 1026)

    def full(self: MappedColumns, row: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(MappedColumns, "back", full)
    replay.commit(b"1026")
    replay._store._backed = 0  # type: ignore[union-attr]  # as if a chunk ended here
    for number in range(1027, 1040):  # over the ring's end, 1028 rows long
        add(replay, number)
        replay.commit(b"lost")
    assert replay.fault is not None and replay.fault.errno == errno.ENOSPC
    assert (held(replay), replay.unbacked) == ([1036, 1037, 1038, 1039], 13)
    monkeypatch.undo()
    again = reopened(tmp_path)
    assert (held(again), note(again)) == ([1023, 1024, 1025, 1026], b"1026")


def test_a_store_that_is_given_up_while_another_thread_looks_is_looked_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class GivenUp:
        """After the first look."""

        def __get__(self, replay: Replay, kind: type[Replay]) -> store.Store | None:
            found: store.Store | None = replay.__dict__.get("_store")
            replay.__dict__["_store"] = None
            return found

        def __set__(self, replay: Replay, found: store.Store | None) -> None:
            replay.__dict__["_store"] = found

    monkeypatch.setattr(Replay, "_store", GivenUp(), raising=False)
    replay = reopened(tmp_path)
    record = replay.committed
    assert record is not None
    reopened(tmp_path).sync(record)


def test_a_directory_that_cannot_be_made_leaves_it_in_memory(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    replay = reopened(tmp_path / "file" / "replay")
    assert isinstance(replay.fault, NotADirectoryError)
    live(replay, 0, 5)
    assert (held(replay), replay.unbacked) == ([2, 3, 4, 5], 6)


def test_the_disks_place_is_taken_before_it_is_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "posix_fallocate", lambda fd, begin, size: taken.append((begin, size)))
    monkeypatch.setattr("learner.columns.CHUNK_BYTES", 100 * 29)  # a row has 8 + 4 + 4 + 8 + 1 + 4 bytes
    replay = reopened(tmp_path)
    taken.clear()
    live(replay, 0, 99)
    assert taken == [(0, 800), (0, 400), (0, 400), (0, 800), (0, 100), (0, 400)]
    live(replay, 100, 100)
    assert taken[6:8] == [(800, 800), (400, 400)]
    taken.clear()
    live(reopened(tmp_path), 101, 101)  # has its place, asks for it all the same
    assert taken[1] == (800, 800)  # after that of the marks
