"""What `tenuto run` does once its processes have ended."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import pytest

from launcher import regret, run
from launcher.cli import DONE, FAILED
from launcher.supervisor import End, Interrupts
from rtcore.bus import Bus
from rtcore.clock import VirtualClock
from rtcore.memory_bus import MemoryHub
from tests.launcher.test_streams import read_until


class Ended:
    """Stands in for the supervisor: all have ended, the recorder badly."""

    def __init__(self, *arguments: object, **more: object) -> None:
        pass

    def started(self) -> AbstractContextManager[None]:
        return nullcontext()

    def supervise(self, interrupts: Interrupts, on_poll: Callable[[frozenset[str]], None]) -> End:
        on_poll(frozenset())
        return End("duration")

    def ended_well(self, process: str) -> bool:
        return False


def end(
    path: Path,
    monkeypatch: pytest.MonkeyPatch,
    mend: Callable[[Path, Interrupts], object] = lambda recording, interrupts: None,
    supervisor: type[Ended] = Ended,
) -> int:
    def bus(*arguments: object, **more: object) -> AbstractContextManager[Bus]:
        return nullcontext(MemoryHub().bus("client", VirtualClock()))

    for name, stand_in in {"Supervisor": supervisor, "open_bus": bus, "mend": mend, "NICENESS": 0}.items():
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


@pytest.mark.parametrize("times", [1, 2])
def test_who_interrupted_twice_does_not_wait_for_the_regret(
    times: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mend(recording: Path, interrupts: Interrupts) -> None:
        interrupts.count += times

    assert end(tmp_path / "r1", monkeypatch, mend) == DONE
    summary = json.loads((tmp_path / "r1" / "summary.json").read_text())
    assert summary["regret"] is None
    assert (summary["regret_missing"] == "interrupted") is (times == 2)


def test_a_ctrl_c_after_that_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def of_run(*arguments: object) -> dict[str, object]:
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
        return {"regret": None, "regret_missing": "computed"}

    monkeypatch.setattr(regret, "of_run", of_run)
    handler = signal.getsignal(signal.SIGINT)
    assert end(tmp_path / "r1", monkeypatch) == DONE
    assert signal.getsignal(signal.SIGINT) == handler
    assert json.loads((tmp_path / "r1" / "summary.json").read_text())["regret_missing"] == "computed"
    assert "counts" in capsys.readouterr().out


def test_whoever_watched_may_go_with_the_pipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def mend(recording: Path, interrupts: Interrupts) -> None:
        sys.stderr.write("a complaint\n")
        sys.stderr.flush()

    there, here = os.pipe()
    os.close(there)
    with os.fdopen(here, "w") as gone:
        monkeypatch.setattr(sys, "stdout", gone)
        monkeypatch.setattr(sys, "stderr", gone)
        assert end(tmp_path / "r1", monkeypatch, mend) == DONE
    assert (tmp_path / "r1" / "summary.json").is_file()


def test_whoever_watched_may_go_with_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal, ours = os.openpty()

    class Unwatched(Ended):
        def supervise(self, interrupts: Interrupts, on_poll: Callable[[frozenset[str]], None]) -> End:
            found = super().supervise(interrupts, on_poll)
            read_until(b"starting", terminal)  # a screen was there
            os.close(terminal)
            return found

    with os.fdopen(ours, "w") as gone:
        monkeypatch.setattr(sys, "stdout", gone)
        assert end(tmp_path / "r1", monkeypatch, supervisor=Unwatched) == DONE
    assert (tmp_path / "r1" / "summary.json").is_file()


def test_a_summary_that_the_disk_does_not_take_costs_neither_the_report_nor_goes_unsaid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def mend(recording: Path, interrupts: Interrupts) -> None:
        (recording.parent / "summary.json").mkdir()  # no file can take its place

    assert end(tmp_path / "r1", monkeypatch, mend) == FAILED
    said = capsys.readouterr()
    assert said.err == f"tenuto: {tmp_path / 'r1' / 'summary.json'} is not written: Is a directory\n"
    assert "counts" in said.out
