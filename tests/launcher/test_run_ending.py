"""What `tenuto run` does once its processes have ended."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import pytest

from launcher import run
from launcher.cli import DONE, FAILED
from launcher.supervisor import End, Interrupts
from rtcore.bus import Bus
from rtcore.clock import VirtualClock
from rtcore.memory_bus import MemoryHub


class Ended:
    """Stands in for the supervisor: all have ended, the recorder badly."""

    def __init__(self, *arguments: object, **more: object) -> None:
        pass

    def started(self) -> AbstractContextManager[None]:
        return nullcontext()

    def supervise(self, interrupts: Interrupts, on_poll: object) -> End:
        return End("duration")

    def ended_well(self, process: str) -> bool:
        return False


def end(path: Path, monkeypatch: pytest.MonkeyPatch, mend: Callable[[Path, Interrupts], object]) -> int:
    def bus(*arguments: object, **more: object) -> AbstractContextManager[Bus]:
        return nullcontext(MemoryHub().bus("client", VirtualClock()))

    for name, stand_in in {"Supervisor": Ended, "open_bus": bus, "mend": mend, "NICENESS": 0}.items():
        monkeypatch.setattr(run, name, stand_in)
    return run.run(["pointmass", "--run-dir", str(path), "--agent.rt", "off"])


def test_a_ctrl_c_while_the_recording_is_completed_does_not_cost_the_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = []

    def mend(recording: Path, interrupts: Interrupts) -> None:
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
            counts.append((interrupts.count, interrupts.first_s))

    assert end(tmp_path / "r1", monkeypatch, mend) == DONE
    (first, first_s), (second, second_s) = counts
    assert (first, second) == (1, 2)
    assert first_s == second_s < float("inf")
    assert json.loads((tmp_path / "r1" / "summary.json").read_text())["preset"] == "pointmass"


def test_a_summary_that_the_disk_does_not_take_costs_neither_the_report_nor_goes_unsaid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def mend(recording: Path, interrupts: Interrupts) -> None:
        (recording.parent / "summary.json").mkdir()  # no file can take its place

    assert end(tmp_path / "r1", monkeypatch, mend) == FAILED
    said = capsys.readouterr()
    assert said.err == f"tenuto: {tmp_path / 'r1' / 'summary.json'} is not written: Is a directory\n"
    assert "counts" in said.out
