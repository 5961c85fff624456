"""The tally: nothing counted is lost to a kill -9, and no group is ever seen in part."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rtcore import tally
from rtcore.ledger import EVENTS_DROPPED, MAX_EVENTS, Ledger
from rtcore.tally import MAX_NAMES, SIZE, Tally, read

ROOT = Path(__file__).parents[2]


class KilledError(Exception):
    """The process ends here."""


class Brittle:
    """The cells of a tally, for so many stores; then the process ends."""

    def __init__(self, cells: Any, stores: int) -> None:
        self.cells = cells
        self.left = stores

    def __getitem__(self, place: int) -> int:
        return int(self.cells[place])

    def __setitem__(self, place: int, value: int) -> None:
        if self.left == 0:
            raise KilledError
        self.left -= 1
        self.cells[place] = value


@contextmanager
def counting(path: Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "tests.rtcore.tally_child", str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout is not None and child.stdout.readline() == "ready\n"
            yield child
        finally:
            child.kill()


def test_what_was_set_is_read_while_it_is_written_and_afterwards(tmp_path: Path) -> None:
    path = tmp_path / "a.tally"
    with Tally.create(path) as kept:
        assert read(path) == {}
        kept.set("ticks", 1)
        kept.set_together({"missed": 2, "missed.agent_late": 2**63 - 1})
        kept.set("ticks", 3)
        assert read(path) == {"ticks": 3, "missed": 2, "missed.agent_late": 2**63 - 1}
    kept.set("ticks", 4)  # too late: a thread that was left behind does no harm
    kept.set_together({"ticks": 5})
    assert read(path) == {"ticks": 3, "missed": 2, "missed.agent_late": 2**63 - 1}
    with pytest.raises(FileExistsError):
        Tally.create(path)


def test_a_group_is_never_seen_in_part_wherever_the_process_ends(tmp_path: Path) -> None:
    """Two places and values, their number, begun, two values, done: 9 stores. The group counts from the
    sixth on, when it is declared as begun."""
    seen = []
    for stores in range(10):
        path = tmp_path / f"{stores}.tally"
        with Tally.create(path) as kept:
            kept.set_together({"a": 1, "b": 1, "c": 1})
            kept._cells = Brittle(kept._cells, stores)  # type: ignore[assignment]
            try:
                kept.set_together({"a": 2, "c": 2})
            except KilledError:
                assert stores < 9
            seen.append(read(path))
    before, after = {"a": 1, "b": 1, "c": 1}, {"a": 2, "b": 1, "c": 2}
    assert seen == [before] * 6 + [after] * 4


def test_a_new_name_is_seen_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.tally"
    with Tally.create(path) as kept:
        kept.set("first", 1)
        kept._cells = Brittle(kept._cells, 0)  # type: ignore[assignment]
        with pytest.raises(KilledError):
            kept.set("second", 2)
        assert read(path) == {"first": 1}


def test_a_kill_at_any_instant_loses_nothing(tmp_path: Path) -> None:
    instants = random.Random(6)
    for number in range(6):
        path = tmp_path / f"{number}.tally"
        with counting(path) as child:
            time.sleep(instants.uniform(0.001, 0.05))
            child.send_signal(signal.SIGKILL)
            child.wait(10)
        found = read(path)
        assert found["ticks"] == found["produced"] > 100
        assert found["ticks"] - found["published"] in (0, 1)


def test_a_reader_beside_the_writer_never_sees_a_group_in_part(tmp_path: Path) -> None:
    path = tmp_path / "a.tally"
    with counting(path):
        seen, limit_s = [read(path)], time.monotonic() + 20
        while seen[-1].get("ticks", 0) < 5_000 and time.monotonic() < limit_s:
            seen.append(read(path))
    assert [one for one in seen if one.get("ticks", 0) != one.get("produced", 0)] == []
    assert seen[-1]["ticks"] >= 5_000


@pytest.mark.parametrize("length", [0, 7, 8, 64, 400, SIZE - 1])
def test_a_torn_file_is_no_tally(tmp_path: Path, length: int) -> None:
    path = tmp_path / "a.tally"
    with Tally.create(path) as kept:
        kept.set("ticks", 1)
    path.write_bytes(path.read_bytes()[:length])
    assert read(path) == {}


def test_a_file_of_anything_is_read_without_an_error(tmp_path: Path) -> None:
    path, noise = tmp_path / "a.tally", random.Random(1)
    path.write_bytes(bytes(SIZE))
    assert read(path) == {}
    for _ in range(50):
        path.write_bytes(tally.MAGIC + noise.randbytes(SIZE - 8))
        assert all(value >= 0 for value in read(path).values())
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none")


def test_what_has_no_place_is_in_the_ledger_all_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.tally"
    with Tally.create(path) as kept:
        ledger = Ledger("learner", 1, kept)
        names = [f"counter.{number}" for number in range(MAX_NAMES + 2)]
        for name in [*names, "x" * 56]:
            ledger.count(name, 2)
        ledger.count_together(names[0], names[-1])
        assert len(read(path)) == MAX_NAMES
        assert (read(path)[names[0]], ledger.counter(names[0])) == (3, 3)
        assert (ledger.counter(names[-1]), ledger.counter("x" * 56)) == (3, 2)
        with pytest.raises(ValueError, match="17 counters: at most 16"):
            kept.set_together(dict.fromkeys(names[:17], 1))


def test_a_ledger_keeps_every_counter_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.tally"
    with Tally.create(path) as kept:
        ledger = Ledger("env_server", 1, kept)
        ledger.count("missed", 0)
        ledger.count("skipped", 3)
        ledger.set_counter("messages.rejected", 7)
        ledger.count_together("ticks", "produced")
        ledger.count_together("ticks", "resets")
        for number in range(MAX_EVENTS + 1):
            ledger.event(number, "DEBUG", "again")
        assert read(path) == dict(ledger.stats(1).counters)
        assert read(path)["ticks"] == 2
        assert read(path)[EVENTS_DROPPED] == 1


def test_a_full_disk_is_said_at_the_start_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int, offset: int, length: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    with pytest.raises(OSError, match="No space left"):
        Tally.create(tmp_path / "a.tally")
    assert list(tmp_path.iterdir()) == []


def test_the_greater_of_two_accounts_counts() -> None:
    assert tally.raised({"a": 1, "b": 5}, {"b": 4, "a": 2, "c": 3}) == {"a": 2, "b": 5, "c": 3}


def test_a_group_that_is_counted_while_the_file_is_read_is_read_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The head and the first value are read, then both counters rise, then the rest is read."""
    path, pread, calls = tmp_path / "a.tally", os.pread, list[int]()
    torn_at = 8 * (tally._VALUES + 1)
    with Tally.create(path) as kept:
        kept.set_together({"a": 1, "b": 1})

        def slow(descriptor: int, length: int, offset: int) -> bytes:
            calls.append(length)
            if len(calls) != 2:
                return pread(descriptor, length, offset)
            early = pread(descriptor, torn_at, 0)
            kept.set_together({"a": 2, "b": 2})
            return early + pread(descriptor, length - torn_at, torn_at)

        monkeypatch.setattr("rtcore.tally.os.pread", slow)
        assert read(path) == {"a": 2, "b": 2}
    assert len(calls) == 6  # a second try
