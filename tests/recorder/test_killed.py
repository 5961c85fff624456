"""Kill -9 at the worst instants: the recording is the one of a recorder that nobody killed."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pyarrow as pa
import pytest

from recorder import finish, reading
from recorder.finish import parts_of
from tests.recorder.killed_child import STEPS
from tests.recorder.killed_child import main as live
from tests.recorder.stage import SPEC, come_back, make_step, set_stage


def die(directory: Path, what: str, n: int, envs: int = 1) -> int:
    command = [sys.executable, "-m", "tests.recorder.killed_child", str(directory), what, str(n), str(envs)]
    return subprocess.run(command, cwd=Path.cwd(), check=False).returncode


def rows(path: Path) -> Counter[str]:
    """Every row of every entity, with all its timelines and components."""
    found: Counter[str] = Counter()
    for chunk in reading._chunks(path, is_static=False):
        batch = chunk.to_record_batch()
        columns = {
            name: column.cast(pa.int64()) if pa.types.is_temporal(column.type) else column
            for name, column in zip(batch.schema.names, batch.columns, strict=True)
            if not name.endswith("RowId")
        }
        for row in zip(*(column.to_pylist() for column in columns.values()), strict=True):
            cells = {name: cell for name, cell in zip(columns, row, strict=True) if cell is not None}
            found[f"{chunk.entity_path} {sorted(cells.items())}"] += 1
    return found


def test_rows_of_a_recorder_that_is_killed_again_and_again_are_those_of_one_that_lives(
    tmp_path: Path,
) -> None:
    live(str(tmp_path / "undisturbed"), "never", "0")
    # In the midst of a chunk; of its place; between the two; and after both. Each goes on a little further.
    for what, n in (("recording", 3), ("recorded", 3), ("place", 4), ("placed", 4)):
        assert die(tmp_path / "killed", what, n) == -signal.SIGKILL
    live(str(tmp_path / "killed"), "never", "0")
    path = tmp_path / "killed" / "runs" / "r1" / "recording.rrd"
    assert parts_of(path) == []
    expected = rows(tmp_path / "undisturbed" / "runs" / "r1" / "recording.rrd")
    assert set(expected.values()) == {1}
    assert rows(path) == expected
    assert reading.columns(path, "/env/reward")[0].tolist() == list(range(STEPS))
    assert reading.series(path, "/learner/forecast") == ["a", "b0", "b1", "b2"]


def test_so_are_those_of_each_environment_of_a_fleet(tmp_path: Path) -> None:
    live(str(tmp_path / "undisturbed"), "never", "0", "3")
    for what, n in (("recorded", 3), ("place", 4)):
        assert die(tmp_path / "killed", what, n, envs=3) == -signal.SIGKILL
    live(str(tmp_path / "killed"), "never", "0", "3")
    path = tmp_path / "killed" / "runs" / "r1" / "recording.rrd"
    expected = rows(tmp_path / "undisturbed" / "runs" / "r1" / "recording.rrd")
    assert set(expected.values()) == {1}
    assert rows(path) == expected
    for root in reading.env_roots(path):
        assert reading.columns(path, f"{root}/env/reward")[0].tolist() == list(range(STEPS)), root


def test_a_killed_finish_neither_loses_nor_doubles_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = set_stage(tmp_path)
    first.spec.put(SPEC)
    first.steps([make_step(seq) for seq in range(60)])
    first.service.flush()
    settle, calls = finish._settle, []

    def killed(recording: Path) -> None:
        calls.append(recording)
        if len(calls) == 3:  # of the recorder's start, of the beginning of `finish`, and of its end
            raise KeyboardInterrupt
        settle(recording)

    monkeypatch.setattr(finish, "_settle", killed)
    second = come_back(first)
    second.steps([make_step(seq) for seq in range(80)], size=80)
    with pytest.raises(KeyboardInterrupt):
        second.service.close()
    monkeypatch.setattr(finish, "_settle", settle)
    assert len(parts_of(second.path)) == 1
    third = come_back(second)
    third.steps([make_step(seq) for seq in range(100)], size=100, last=True)
    third.service.close()
    assert reading.columns(third.path, "/env/reward")[0].tolist() == list(range(100))
    assert [path.name for path in third.path.parent.glob("*.rrd")] == ["recording.rrd"]
    assert not list(third.path.parent.glob(".recording*"))


@pytest.mark.parametrize("gone", [False, True])
def test_without_a_place_what_there_was_is_kept_all_the_same_and_it_is_told(
    gone: bool, tmp_path: Path
) -> None:
    first = set_stage(tmp_path)
    first.spec.put(SPEC)
    first.steps([make_step(seq) for seq in range(60)])
    first.service.flush()
    place = first.run_dir.logs_dir / "recorder.place"
    if gone:
        place.unlink()
    else:
        place.write_bytes(b"\xff" * 70_000)
    second = come_back(first)
    second.steps([make_step(seq) for seq in range(80)], size=80, last=True)
    second.service.close()
    ticks = reading.columns(second.path, "/env/reward")[0].tolist()
    assert sorted(set(ticks)) == list(range(80))
    why = "No such file or directory" if gone else "damaged, or of another version"
    assert [event.text for event in second.events() if event.level == "WARN"] == [
        "the recording goes on, but how far it had got is not known: its last rows may come twice "
        f"(recorder.place: {why})"
    ]


def test_what_a_dead_recorder_could_not_have_is_counted(tmp_path: Path) -> None:
    first = set_stage(tmp_path)
    first.spec.put(SPEC)
    first.steps([make_step(seq) for seq in range(60)])
    first.service.flush()
    second = come_back(first)
    second.steps([make_step(seq) for seq in range(75, 100)], last=True)  # the log goes back no further
    second.service.close()
    assert second.ledger.counter("dropped") == 15
    assert reading.columns(second.path, "/env/reward")[0].tolist() == [*range(60), *range(75, 100)]
