"""`tenuto sim` from the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from launcher.cli import FAILED, run_command
from rtcore.run_dir import RunDir


def test_a_summary_that_cannot_be_written_is_one_line_and_the_report_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(RunDir, "summary_path", property(lambda run: run.path / "none" / "summary.json"))
    run = tmp_path / "run"
    arguments = ["sim", "chain", "--duration-s", "1", "--run-dir", str(run), "--no-record"]
    assert run_command(arguments) == FAILED
    shown = capsys.readouterr()
    assert shown.err == f"tenuto: {run / 'none' / 'summary.json'} is not written: No such file or directory\n"
    assert "transitions" in shown.out
