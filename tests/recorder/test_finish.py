"""A recording survives what happens to its recorder."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import pytest

from recorder import finish, reading
from recorder.finish import FinishError, TooSlowError, run_cli
from recorder.frames import MESSAGE_HEAD, STREAM_HEAD

T = TypeVar("T")

CHILD = """
import sys
from pathlib import Path
from tests.recorder.stage import SPEC, make_step, set_stage

stage = set_stage(Path(sys.argv[1]))
stage.spec.put(SPEC)
for begin in range(0, 10_000, 50):
    stage.steps([make_step(seq) for seq in range(begin, begin + 50)], size=50)
    stage.service.flush()
    print(begin + 50, flush=True)
"""


def killed(tmp_path: Path, after: int) -> tuple[Path, int]:
    """The file of a recorder that kill -9 ended in the midst of writing, and the ticks it had written."""
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(tmp_path)], stdout=subprocess.PIPE, text=True, cwd=Path.cwd()
    ) as child:
        assert child.stdout is not None
        written = 0
        while written < after:
            written = int(child.stdout.readline())
        os.kill(child.pid, signal.SIGKILL)
    return tmp_path / "runs" / "r1" / "recording.rrd", written


def test_a_killed_recorders_file_is_repaired_and_has_all_that_was_written(tmp_path: Path) -> None:
    path, written = killed(tmp_path, 300)
    with pytest.raises(FinishError, match="rrd verify failed"):
        run_cli(["rrd", "verify", str(path)], timeout_s=10)
    finish.finish(path)
    run_cli(["rrd", "verify", str(path)], timeout_s=10)
    ticks = reading.columns(path, "/env/reward")[0].tolist()
    assert ticks == list(range(len(ticks)))
    assert len(ticks) >= written


def test_a_torn_file_is_repaired(tmp_path: Path) -> None:
    path, _ = killed(tmp_path, 100)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(RuntimeError, match="exceeds file size"):
        reading.columns(path, "/env/reward")
    assert finish.main([str(path)]) == 0
    assert len(reading.columns(path, "/env/reward")[0]) >= 50


def test_what_is_no_recording_stays_as_it_is(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "recording.rrd"
    path.write_text("not a recording")
    assert finish.main([str(path)]) == 1
    assert capfd.readouterr().err == "recording.rrd is no recording\n"
    assert path.read_text() == "not a recording"
    assert [found.name for found in tmp_path.iterdir()] == ["recording.rrd"]
    assert finish.main([str(tmp_path / "absent.rrd")]) == 1


def test_too_slow_is_a_failure_and_leaves_nothing_running(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "recording.rrd"
    path.write_bytes(finish.MAGIC)
    monkeypatch.setattr(finish, "CLI", "import time; time.sleep(60)")
    with pytest.raises(FinishError, match=r"rrd optimize took over 0\.5 s"):
        finish.finish(path, timeout_s=0.5)
    left = subprocess.run(["pgrep", "-f", str(path)], capture_output=True, text=True, check=False)
    assert left.stdout == ""


def test_the_tool_dies_with_a_recorder_that_is_killed(tmp_path: Path) -> None:
    pipe = tmp_path / "never"
    os.mkfifo(pipe)  # it waits for somebody who writes
    code = f"from recorder.finish import run_cli; run_cli(['rrd', 'verify', {str(pipe)!r}], timeout_s=60)"
    with subprocess.Popen([sys.executable, "-c", code], env={"TMPDIR": str(tmp_path)}) as recorder:
        tool = until(lambda: child_of(recorder.pid, "rerun"))
        recorder.kill()
    until(lambda: not alive(tool))


def until(look: Callable[[], T]) -> T:
    limit_s = time.monotonic() + 20
    while not (found := look()):
        assert time.monotonic() < limit_s
        time.sleep(0.02)
    return found


def child_of(pid: int, name: str) -> int:
    found = subprocess.run(["pgrep", "-x", "-P", str(pid), name], capture_output=True, check=False)
    return int(found.stdout or 0)


def alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]
    except FileNotFoundError:
        return False


def test_what_a_killed_finish_left_is_removed_and_what_another_is_at_is_not(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    for pid in (ended.pid, os.getpid(), os.getppid()):
        workshop = tmp_path / f".recording.finishing-{pid}"
        workshop.mkdir()
        (workshop / "recording.rrd").write_text("half of it")
    with pytest.raises(FinishError, match="nothing was written"):
        finish.finish(tmp_path / "recording.rrd")
    assert [left.name for left in tmp_path.iterdir()] == [f".recording.finishing-{os.getppid()}"]


def test_without_the_time_for_more_the_parts_are_joined_all_the_same(tmp_path: Path) -> None:
    path, written = killed(tmp_path, after=100)
    whole = reading.columns(path, "/env/reward")[0].tolist()
    path.rename(part := path.with_name("recording.part000.rrd"))
    messages = part.read_bytes()[STREAM_HEAD:]
    later = part.read_bytes()[:STREAM_HEAD] + messages
    path.write_bytes(later + MESSAGE_HEAD.pack(2, 1000) + b"torn")
    with pytest.raises(TooSlowError):
        finish.finish(path, timeout_s=0.01)
    assert not list(path.parent.glob(".recording*"))
    assert finish.files_of(path) == [path]
    assert path.read_bytes() == later + messages
    ticks = reading.columns(path, "/env/reward")[0].tolist()
    assert len(whole) >= written
    assert ticks == sorted(2 * whole)  # the part, and what was written after it


def test_what_takes_longer_than_there_is_time_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "recording.rrd"
    path.write_bytes(finish.MAGIC)
    monkeypatch.setattr(finish, "run_cli", lambda *_, **__: pytest.fail("begun"))
    for megabytes in (250, 900):
        os.truncate(path, megabytes * 1_000_000)  # takes no room
        with pytest.raises(TooSlowError, match=re.escape(f"{megabytes} MB take over 10 s")):
            finish.finish(path, timeout_s=10.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["recording.rrd"]
    patience: list[float] = []
    monkeypatch.setattr(finish, "finish", lambda _, *, timeout_s: patience.append(timeout_s))
    assert finish.main([str(path)]) == 0
    assert finish.main(["--within-s", "12", str(path)]) == 0
    assert patience == [225.0, 12.0]  # 4 MB/s


def test_the_time_is_for_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[float] = []

    def slow(arguments: Sequence[str], *, timeout_s: float, home_in: Path) -> str:
        assert home_in.parent == tmp_path
        given.append(timeout_s)
        time.sleep(0.2)
        (home_in / "recording.rrd").write_bytes(finish.MAGIC)
        return ""

    monkeypatch.setattr(finish, "run_cli", slow)
    path = tmp_path / "recording.rrd"
    path.write_bytes(finish.MAGIC)
    finish.finish(path, timeout_s=5.0)
    finish.finish(path, timeout_s=0.1)
    assert given[0] == 5.0 and 0.0 < given[1] <= 4.8
    assert given[2:] == [0.1, 0.0]
    assert list(tmp_path.iterdir()) == [path]


def test_parts_are_numbered_and_kept_until_they_are_taken_in(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    assert finish.set_aside(path) is None
    path.touch()
    assert finish.set_aside(path) is None
    names = []
    for _ in range(2):
        path.write_text("x")
        part = finish.set_aside(path)
        assert part is not None
        names.append(part.name)
    assert names == ["recording.part000.rrd", "recording.part001.rrd"]
    path.write_bytes(finish.MAGIC)
    with pytest.raises(FinishError, match=r"part000\.rrd is no recording"):
        finish.finish(path)
    assert [part.name for part in finish.parts_of(path)] == names


def test_usage_statistics_are_off_and_the_users_settings_are_not_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path.parent)
    Path("homes").mkdir(exist_ok=True)
    for home_in in (None, Path("homes")):  # a relative one is no use to the tool
        settings = run_cli(["analytics", "config"], timeout_s=10, home_in=home_in)
        found = json.loads(settings[settings.index("{") :])
        assert found["analytics_enabled"] is False
        assert Path(found["config_file_path"]).is_absolute()
    assert list(tmp_path.iterdir()) == []
