"""`tenuto latency`: the real command, short. Its three runs are made at once: they mostly wait."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.launcher.commands import command_line, tenuto

pytestmark = pytest.mark.timeout(120)


@dataclass(frozen=True)
class Done:
    """A finished command."""

    home: Path
    returncode: int
    stdout: str
    stderr: str


def measure(home: Path) -> Done:
    return at(home, "--seconds", "1.5", "--out", str(home / "here" / "results"))


def search(home: Path) -> Done:
    return at(home, "--hold-rate", "--limit", "0.3", "--out", "results")


def at(home: Path, *arguments: str) -> Done:
    done = tenuto("latency", "--hz", "50", "--load", "none", *arguments, cwd=home, timeout_s=100)
    return Done(home, done.returncode, done.stdout, done.stderr)


def interrupt(home: Path) -> Done:
    arguments = ["latency", "--hz", "50", "--load", "none", "--seconds", "60", "--out", "results"]
    command = ["env", f"TMPDIR={home}", *command_line(*arguments)]
    with subprocess.Popen(command, cwd=home, stdout=subprocess.PIPE, text=True) as process:
        wait_for_ticks(home, process)
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=40)
    return Done(home, process.returncode, said, "")


def wait_for_ticks(temporary: Path, process: subprocess.Popen[str], limit_s: float = 40.0) -> None:
    """Until the env server of the trial below `temporary` says that it ticks."""
    deadline = time.monotonic() + limit_s
    while not any(" Hz" in log.read_text() for log in temporary.glob("*/run/logs/env_server.jsonl")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Future[Done]]:
    runs = (measure, search, interrupt)
    with ThreadPoolExecutor(len(runs)) as pool:
        return {run.__name__: pool.submit(run, tmp_path_factory.mktemp(run.__name__)) for run in runs}


def test_the_real_command(commands: dict[str, Future[Done]]) -> None:
    done = commands["measure"].result()
    out = done.home / "here" / "results"
    assert done.returncode == 0, done.stdout + done.stderr
    assert {path.name for path in out.iterdir()} == {"latency.json", "latency.png"}
    assert set(done.home.iterdir()) == {done.home / "here"}
    found = json.loads((out / "latency.json").read_text())
    (cell,) = found["cells"]
    system = cell["system"]
    assert system["ticks"] + system["skipped"] == 75 and system["unseen_ticks"] == 0
    assert sum(system["missed_by_cause"].values()) == system["missed"]
    assert set(cell["echo"]) == {"zenoh", "unix"}
    for echo in cell["echo"].values():
        assert echo["ticks"] + echo["skipped"] == 75
        assert echo["round_trip_us"]["p50"] > 0
    assert system["loop_us"]["p50"] > 0 and "collector frozen" in system["placement"]["env_server"]
    assert "bare Zenoh echo" in done.stdout and str(out / "latency.png") in done.stdout.replace("\n", "")


def test_the_real_search(commands: dict[str, Future[Done]]) -> None:
    done = commands["search"].result()
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((done.home / "results" / "latency.json").read_text())
    first, *_ = attempts = found["hold_rate"]["attempts"]
    assert found["hold_rate"]["ended"] and found["cells"] == []
    assert first["counted"]["ticks"] == 9  # ln 0.05 / ln 0.7 = 8.4: no longer than the confirmation
    assert [attempt["stage"] for attempt in attempts] == ["screening", "confirmation"][: len(attempts)]
    assert (found["hold_rate"]["established_hz"] == 50.0) == (len(attempts) == 2 and attempts[1]["passed"])
    assert "50 Hz" in done.stdout and not (done.home / "results" / "latency.png").exists()


def test_ctrl_c_keeps_what_is_there(commands: dict[str, Future[Done]]) -> None:
    done = commands["interrupt"].result()
    assert done.returncode == 0, done.stdout
    assert {path.name for path in done.home.iterdir()} == {"results"}
    found = json.loads((done.home / "results" / "latency.json").read_text())
    (cell,) = found["cells"]
    assert found["interrupted"] and cell["system"]["interrupted"] and cell["echo"] == {}
    assert 0 < cell["system"]["ticks"] < 3000
    assert "interrupted before its time" in done.stdout


def test_wrong_input_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    for arguments, word in ((["--hz", "fast"], "hz = 'fast'"), (["--out", "taken"], "out = 'taken'")):
        done = tenuto("latency", *arguments, cwd=tmp_path)
        assert done.returncode == 2
        assert done.stderr.startswith(f"tenuto: {word}") and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == [tmp_path / "taken"]
