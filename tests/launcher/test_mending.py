from __future__ import annotations

import os
import shutil
import sys
import time
from pathlib import Path

import pytest

from launcher.mending import INTERRUPTED_LIMIT_S, mend
from launcher.supervisor import Interrupts
from recorder import reading
from recorder.finish import run_cli, set_aside
from tests.recorder.test_finish import killed


@pytest.mark.parametrize("parted", [False, True])  # the last life died before it had a file of its own
def test_what_a_killed_recorder_left_is_completed(parted: bool, tmp_path: Path) -> None:
    path, written = killed(tmp_path, 100)
    if parted:
        set_aside(path)
    assert mend(path, Interrupts())
    run_cli(["rrd", "verify", str(path)], timeout_s=10)
    assert len(reading.columns(path, "/env/reward")[0]) >= written


def test_what_cannot_be_completed_is_said_with_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "recording.rrd"
    assert not mend(path, Interrupts())
    assert capsys.readouterr().err == ""  # it died before it had a file: nothing to complete
    path.write_bytes(b"something else")
    assert not mend(path, Interrupts())
    assert capsys.readouterr().err == (
        "tenuto: the recording is not completed (recording.rrd is no recording); to complete it: "
        f"python -m recorder.finish {path}\n"
    )
    assert path.read_bytes() == b"something else"


def test_the_parts_of_what_is_too_long_to_be_compacted_are_joined_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = killed(tmp_path, 100)
    ticks = reading.columns(path, "/env/reward")[0].tolist()
    part = set_aside(path)
    assert part is not None
    shutil.copy(part, path)
    os.truncate(path, 300_000_000)  # takes no room, and reads as an end of the messages
    assert not mend(path, Interrupts())
    assert capsys.readouterr().err == (
        "tenuto: the recording is not completed (300 MB take over 12 s); to complete it: "
        f"python -m recorder.finish {path}\n"
    )
    assert [found.name for found in path.parent.glob("*.rrd")] == ["recording.rrd"]
    assert reading.columns(path, "/env/reward")[0].tolist() == sorted(2 * ticks)


def test_who_interrupts_leaves_time_to_join_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tool, path = tmp_path / "tool", tmp_path / "recording.rrd"
    tool.write_text('#!/bin/sh\necho "$4"\nexit 1\n')  # python -m recorder.finish --within-s S
    tool.chmod(0o755)
    path.touch()
    monkeypatch.setattr(sys, "executable", str(tool))
    interrupts = Interrupts()
    interrupts.count, interrupts.first_s = 1, time.monotonic() - INTERRUPTED_LIMIT_S + 2.0
    assert not mend(path, interrupts)
    given = float(capsys.readouterr().err.partition("(")[2].partition(")")[0])
    assert 0.5 < given <= 1.2


@pytest.mark.parametrize(("count", "ago_s"), [(1, INTERRUPTED_LIMIT_S - 0.5), (2, 0.0)])
def test_who_interrupts_does_not_wait_even_for_a_tool_that_does_not_end(
    count: int,
    ago_s: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    tool, path = tmp_path / "tool", tmp_path / "recording.rrd"
    tool.write_text("#!/bin/sh\ntrap '' INT\nexec sleep 30\n")
    tool.chmod(0o755)
    path.touch()
    monkeypatch.setattr(sys, "executable", str(tool))
    interrupts, began_s = Interrupts(), time.monotonic()
    interrupts.count, interrupts.first_s = count, began_s - ago_s
    assert not mend(path, interrupts)
    assert time.monotonic() - began_s < 4.0  # 0.7 s, 0.2 s
    assert "(it takes too long)" in capsys.readouterr().err
