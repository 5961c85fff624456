from __future__ import annotations

from pathlib import Path

import pytest

from launcher.mending import mend
from recorder import reading
from recorder.finish import run_cli
from tests.recorder.test_finish import killed


def test_what_a_killed_recorder_left_is_completed(tmp_path: Path) -> None:
    path, written = killed(tmp_path, 100)
    assert mend(path, hurried=False)
    run_cli(["rrd", "verify", str(path)], timeout_s=10)
    assert len(reading.columns(path, "/env/reward")[0]) >= written


def test_what_cannot_be_completed_is_said_with_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "recording.rrd"
    assert not mend(path, hurried=False)
    assert capsys.readouterr().err == ""  # it died before it had a file: nothing to complete
    path.write_bytes(b"something else")
    assert not mend(path, hurried=False)
    assert capsys.readouterr().err == (
        "tenuto: the recording is as the recorder left it (recording.rrd is no recording); to complete it: "
        f"python -m recorder.finish {path}\n"
    )
    assert path.read_bytes() == b"something else"
