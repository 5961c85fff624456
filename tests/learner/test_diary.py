"""The diary of a finite world: what goes in comes out, whatever happens to the process or to the disk."""

from __future__ import annotations

import resource
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np
import pytest

from learner import diary
from learner.diary import FALLBACK, Acted, ActedIn, Diary, Entered, Forecast, Published, Tally
from rtcore.clock import VirtualClock
from rtcore.ledger import Ledger
from rtcore.messages import Architecture, Policy, Spec, Step, WindowNotice
from rtcore.weights import pack, sha256
from rtcore.windows import Window
from tests.learner.service_rig import SPEC, step

FINITE: Spec = msgspec.structs.replace(SPEC, states=2, actions=2, observation_dim=1, t0_ns=30)
TABLE = np.array([[0.25, 0.75], [0.5, 0.5]], np.float32)


def lived(seq: int, version: int = 0, *, missed: bool = False, incarnation: int = 7) -> Step:
    """Ten ticks a unit, the first of all a reset."""
    plain = step(seq, reset=seq == 0, late=missed)
    return msgspec.structs.replace(plain, policy_version=version, incarnation=incarnation)


def policy(version: int = 1, table: np.ndarray = TABLE) -> Policy:
    architecture = Architecture(
        kind="categorical_table", observation_dim=1, action_dim=1, hidden=[], states=2, actions=2
    )
    weights = pack({"probability": table})
    return Policy(
        version=version, window=3, iterate=2, algo="npg", architecture=architecture, weights=weights,
        sha256=sha256(weights), created_ns=99,
    )  # fmt: skip


NOTICE = WindowNotice(window=3, start_unit=9, update_units=2, hold_units=1, phase="hold", at_ns=80)


class Student:
    def window_start(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([[1.0, 2.0], [1 / 3, 0.0]]), np.log([[0.5, 0.5], [0.1, 0.9]])


class Writer:
    """A diary in a directory, with its ledger."""

    def __init__(
        self,
        directory: Path,
        spec: Spec = FINITE,
        *,
        envs: Sequence[str] = ("env0",),
        pending: Mapping[str, Acted] = MappingProxyType({}),
    ) -> None:
        self.path = directory / diary.NAME
        self.ledger = Ledger("learner", 1)
        self.diary = Diary(self.path, VirtualClock(0), self.ledger)
        self.diary.meet(spec, envs, pending)

    def acted(self) -> list[Acted]:
        return [one for one in diary.read(self.path).entries if isinstance(one, Acted)]


def test_everything_comes_back(tmp_path: Path) -> None:
    writer = Writer(tmp_path)
    writer.diary.window(Window(3, 9, 2, 1), 9, Student())
    writer.diary.sent(NOTICE)
    writer.diary.sent(policy())
    writer.diary.acted([lived(1, 4)])
    assert not writer.path.exists()  # nothing is written by who puts
    writer.diary.finish()
    forecast, entered, published, acted = diary.read(writer.path).entries
    assert isinstance(forecast, Forecast) and isinstance(published, Published)
    assert (forecast.window, forecast.start, forecast.update, forecast.hold, forecast.unit) == (3, 9, 2, 1, 9)
    for read, made in zip(forecast.tables(), Student().window_start(), strict=True):
        np.testing.assert_array_equal(read, made)
    assert entered == Entered(window=3, phase="hold", run_ns=50)
    assert (published.version, published.window, published.iterate, published.created_ns) == (1, 3, 2, 99)
    np.testing.assert_array_equal(published.probability, TABLE)
    assert acted == Acted(incarnation=7, next_seq=2, unit=0, ticks={4: 1})


def test_ticks_are_counted_by_unit_and_policy() -> None:
    """Unit 0 is a reset, which no policy acts in, and ticks 1 to 9; the last two of them were missed."""
    steps = [lived(seq, version=seq // 5, missed=seq in (8, 9)) for seq in range(13)]
    tally = Tally()
    assert tally.take(steps[:10]) == []
    (whole,) = tally.take(steps[10:])
    assert whole == Acted(incarnation=7, next_seq=10, unit=0, ticks={0: 4, 1: 3, FALLBACK: 2})
    (rest,) = tally.finish()
    assert (rest.unit, rest.next_seq, rest.ticks) == (1, 13, {2: 3})
    assert tally.finish() == []


def test_a_restarted_env_server_may_go_on_in_the_same_unit() -> None:
    tally = Tally()
    told = tally.take([lived(1), lived(2), lived(0, incarnation=8), lived(1, incarnation=8)])
    assert [(one.incarnation, one.next_seq, one.ticks) for one in told + tally.finish()] == [
        (7, 3, {0: 2}), (8, 2, {0: 1}),
    ]  # fmt: skip


def test_a_long_unit_is_told_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diary, "MOST_TICKS", 4)
    told = Tally().take([lived(seq) for seq in range(10)])
    assert [one.ticks for one in told] == [{0: 4}, {0: 4}]


def test_a_step_is_counted_once_whatever_an_earlier_learner_told(tmp_path: Path) -> None:
    """Killed in unit 1, it told of unit 0; the next one gets everything again, from the bus's cache."""
    killed = Writer(tmp_path)
    killed.diary.acted([lived(seq) for seq in range(15)])
    killed.diary.flush()
    assert [one.ticks for one in killed.acted()] == [{0: 9}]
    later = Writer(tmp_path)
    later.diary.acted([lived(seq) for seq in range(20)])
    later.diary.acted([lived(seq, incarnation=8) for seq in range(5)])  # the env server came back
    later.diary.finish()
    assert [(one.incarnation, one.unit, one.ticks) for one in later.acted()] == [
        (7, 0, {0: 9}), (7, 1, {0: 10}), (8, 0, {0: 4}),
    ]  # fmt: skip


def test_a_fleet_tells_of_each_environment(tmp_path: Path) -> None:
    """Killed in unit 1 of both, with what it had not told in its replay's note; the next goes on by that."""
    envs = ["env0", "env1"]

    def both(first: int, last: int) -> list[Step]:
        return [
            msgspec.structs.replace(lived(seq, version), env=env)
            for seq in range(first, last)
            for version, env in enumerate(envs)
        ]

    writers = [Writer(tmp_path, envs=envs)]
    writers[0].diary.acted(both(0, 15))
    pending = writers[0].diary.pending
    assert pending == {
        env: Acted(incarnation=7, next_seq=15, unit=1, ticks={version: 5}) for version, env in enumerate(envs)
    }
    writers.append(Writer(tmp_path, envs=envs, pending=pending))
    writers[1].diary.acted(both(12, 20))
    writers[1].diary.finish()
    assert writers[1].acted() == [
        ActedIn(incarnation=7, next_seq=10 * unit + 10, unit=unit, ticks={version: 9 + unit}, env=env)
        for unit in range(2)
        for version, env in enumerate(envs)
    ]
    writers.append(Writer(tmp_path, envs=envs))  # without a note: by what is written
    writers[2].diary.acted(both(15, 21))
    writers[2].diary.finish()
    assert [(one.unit, one.ticks) for one in writers[2].acted()[4:]] == [(2, {0: 1}), (2, {1: 1})]


@pytest.mark.parametrize("kept", [1, 3, 5, -1])
def test_a_torn_entry_is_left_out_and_written_over(kept: int, tmp_path: Path) -> None:
    writer = Writer(tmp_path)
    writer.diary.sent(NOTICE)
    writer.diary.flush()
    whole = writer.path.read_bytes()
    writer.path.write_bytes(whole + whole[:kept])
    found = diary.read(writer.path)
    assert (len(found.entries), found.torn, found.size) == (1, 1, len(whole))
    later = Writer(tmp_path)
    assert later.ledger.counter("diary.torn") == 1
    later.diary.sent(NOTICE)
    later.diary.flush()
    assert later.path.read_bytes() == whole + whole


def test_what_is_no_entry_ends_the_reading(tmp_path: Path) -> None:
    path = tmp_path / diary.NAME
    path.write_bytes(bytes(40))  # as a file that grew before its data were on the disk
    assert diary.read(path) == ([], 1, 0)
    assert diary.read(tmp_path / "none") == ([], 0, 0)


def test_a_full_disk_costs_entries_and_nothing_else(tmp_path: Path) -> None:
    """A limit on the size of files stands for it: the first write beyond is cut short, the next fail."""
    writer = Writer(tmp_path)
    writer.diary.sent(NOTICE)
    writer.diary.flush()
    size = writer.path.stat().st_size
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 3, before[1]))
    try:
        for version in (1, 2):
            writer.diary.sent(policy(version))
        writer.diary.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert writer.ledger.counter("diary.errors") == 2
    assert len(writer.ledger.stats(0).events) == 1
    writer.diary.sent(policy(3))  # there is room again
    writer.diary.flush()
    first, last = diary.read(writer.path).entries
    assert isinstance(first, Entered)
    assert isinstance(last, Published) and last.version == 3


def test_what_cannot_be_read_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / diary.NAME).mkdir()
    writer = Writer(tmp_path)
    writer.diary.acted([lived(1)])
    writer.diary.finish()
    assert writer.ledger.counter("diary.errors") == 1


def test_a_continuous_world_has_none(tmp_path: Path) -> None:
    writer = Writer(tmp_path, SPEC)
    writer.diary.acted([lived(1)])
    writer.diary.window(Window(0, 0, 1, 0), 0, Student())
    writer.diary.sent(NOTICE)
    writer.diary.finish()
    assert not writer.path.exists()


def test_an_algorithm_without_a_bound_tells_of_no_window(tmp_path: Path) -> None:
    writer = Writer(tmp_path)
    writer.diary.window(Window(0, 0, 1, 0), 0, object())
    writer.diary.finish()
    assert diary.read(writer.path).entries == []
