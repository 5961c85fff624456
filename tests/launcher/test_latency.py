"""`tenuto latency`: its figures, its tables and picture exactly, and the real command, short."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from launcher import presets
from launcher.echo.measure import EchoResult
from launcher.latency.command import LatencyOptions, judged, parse_rates, plan
from launcher.latency.hold_rate import Counted
from launcher.latency.picture import draw, envelope, survival
from launcher.latency.results import Cell, Results, as_json
from launcher.latency.table import cell_table, overview, remarks
from launcher.latency.trial import Series, Trial, trial_config
from launcher.machine import processor
from launcher.quantiles import quantiles_us
from launcher.stealing import steal_s
from rtcore.config import ConfigError
from tests.launcher.commands import command_line, tenuto
from tests.rtcore.steps import make_step

# Ten ticks at 4 Hz, of which tick 3 was lost to an overrun; ticks 1 and 8 were missed.
TRIAL = Trial(
    hz=4.0,
    load="learner",
    rt="auto",
    ticks=9,
    missed=2,
    overruns=1,
    skipped=1,
    causes={"env_late": 1, "agent_late": 1},
    updates_per_s=50.0,
    placement={"env_server": "SCHED_OTHER"},
    tick=np.array([0, 1, 2, 4, 5, 6, 7, 8, 9]),
    pacing_ns=np.array([9000, 1000, 1000, 90_000, 2000, 2000, 2000, 2000, 2000]),
    loop_ns=np.array([-1, -1, 400_000, 100_000, 200_000, 200_000, 200_000, -1, 300_000]),
    reaction_ns=np.array([-1, -1, 40_000, 50_000, 50_000, 50_000, 50_000, -1, 50_000]),
    was_missed=np.array([0, 1, 0, 0, 0, 0, 0, 1, 0], np.bool_),
    steal_s=0.25,
    span_s=2.5,
    interrupted=False,
)
ECHO = EchoResult(
    transport="zenoh",
    hz=4.0,
    rt="auto",
    placement="",
    index=np.arange(10),
    pacing_ns=np.full(10, 1000),
    latency_ns=np.array([-1, 100_000, *[160_000] * 8]),
    missed=0,
    overruns=0,
    skipped=0,
    span_s=2.5,
    steal_s=None,
)
CELL = Cell(4.0, "learner", TRIAL, {"zenoh": ECHO})


def results(*cells: Cell) -> Results:
    machine = {"processor": "Some CPU", "cores": 2, "kernel": "6.1"}
    return Results("2026-01-31T00:00:00+00:00", machine, {"env": "pointmass", "rt": "auto"}, list(cells))


def text_of(*renderables: Any) -> str:
    console = Console(file=io.StringIO(), width=100, color_system=None)
    for renderable in renderables:
        console.print(renderable)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_quantile_is_a_value_that_occurred() -> None:
    thousand = np.arange(1, 1001)[::-1] * 1000
    assert quantiles_us(thousand) == {"p50": 500.0, "p99": 990.0, "p999": 999.0, "max": 1000.0}
    assert quantiles_us(np.array([7000])) == {"p50": 7.0, "p99": 7.0, "p999": 7.0, "max": 7.0}
    assert quantiles_us(np.array([], np.int64)) == {"p50": None, "p99": None, "p999": None, "max": None}


def test_a_trial_counts_from_any_second_on() -> None:
    assert TRIAL.since(0.0) == (9, 2)
    assert TRIAL.since(1.0) == (6, 1)  # ticks 4 to 9
    assert TRIAL.quantiles_us("loop") == {"p50": 200.0, "p99": 400.0, "p999": 400.0, "max": 400.0}
    assert TRIAL.quantiles_us("loop", after_s=1.0)["max"] == 300.0
    assert TRIAL.quantiles_us("pacing", after_s=1.25)["max"] == 2.0
    assert TRIAL.unseen == 0 and replace(TRIAL, ticks=12).unseen == 3


def test_a_lost_deadline_is_judged_a_miss() -> None:
    # 2.5 s at 4 Hz are 10 deadlines, 6 of them after the first second: all executed, one missed.
    assert judged(TRIAL, 2.5) == Counted(6, 1)
    # Had it been 3 s, two more deadlines would have been lost.
    assert judged(TRIAL, 3.0) == Counted(8, 3)


def test_the_series_keeps_what_the_log_says() -> None:
    series = Series()
    series.add([make_step(0, due_ns=100, woke_ns=130), make_step(1, missed=True, loop_ns=7, reaction_ns=3)])
    assert list(series.tick) == [100, 101]
    assert list(series.pacing_ns) == [30, 0]
    assert list(series.missed) == [0, 1]
    assert list(series.loop_ns) == [-1, 7]
    assert list(series.reaction_ns) == [-1, 3]


def test_the_ratio_compares_quantiles() -> None:
    assert CELL.ratio("zenoh") == {"p50": 200 / 160, "p99": 2.5, "p999": 2.5, "max": 2.5}
    assert CELL.ratio("unix") == {"p50": None, "p99": None, "p999": None, "max": None}


def test_the_table_says_it_all() -> None:
    lines = text_of(cell_table(CELL)).splitlines()
    assert lines[0].strip() == "4 Hz, learner saturating"
    assert lines[1].split() == ["µs", "p50", "p99", "p99.9", "max", "missed", "steal"]
    assert lines[2].split() == ["pacing", "error", "2.0", "90", "90", "90"]
    assert lines[3].split() == ["reaction", "50", "50", "50", "50"]
    assert lines[4].split() == ["loop", "200", "400", "400", "400", "2", "(22.2", "%)", "0.25", "s"]
    assert lines[5].split() == ["bare", "Zenoh", "echo", "160", "160", "160", "160", "0", "(0.00", "%)", "·"]
    assert lines[6].split() == [
        "loop",
        "/",
        "Zenoh",
        "echo",
        "1.25",
        "×",
        "2.50",
        "×",
        "2.50",
        "×",
        "2.50",
        "×",
    ]


def test_remarks_name_causes_lost_deadlines_and_the_first_second() -> None:
    assert remarks(CELL) == [
        "missed: 1 agent_late, 1 env_late; 1 of them in the first second",
        "overruns: 1, in which 1 deadlines were lost",
    ]
    clean = replace(TRIAL, missed=0, causes={}, overruns=0, skipped=0, ticks=10, interrupted=True)
    assert remarks(Cell(4.0, "none", clean)) == [
        "1 ticks are missing from the percentiles",
        "interrupted before its time",
    ]


def test_the_overview_has_a_line_for_each_cell() -> None:
    last = text_of(overview([CELL])).splitlines()[-1].split()
    assert last == [
        "4",
        "learner",
        "saturating",
        "2",
        "(22.2",
        "%)",
        "90",
        "200",
        "400",
        "1.25",
        "×",
        "2.50",
        "×",
    ]


def test_the_json_has_everything_twice_with_and_without_the_first_second() -> None:
    found = json.loads(json.dumps(as_json(results(CELL))))
    (cell,) = found["cells"]
    assert found["schema"] == 1 and found["interrupted"] is False
    assert cell["system"]["missed_by_cause"] == {"env_late": 1, "agent_late": 1}
    assert cell["system"]["loop_us"]["max"] == 400.0
    assert cell["system"]["settled"]["loop_us"]["max"] == 300.0
    assert (cell["system"]["settled"]["ticks"], cell["system"]["settled"]["missed"]) == (6, 1)
    assert cell["echo"]["zenoh"]["round_trip_us"]["p50"] == 160.0
    assert cell["loop_over_echo"]["zenoh"]["p50"] == 1.25
    assert cell["loop_over_echo_settled"]["zenoh"]["max"] == 1.875


def test_survival_by_hand() -> None:
    x, above = survival(np.array([3000, -1, 1000, 2000, 4000]))
    assert x.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert above.tolist() == [0.75, 0.5, 0.25, 0.25]  # the last would be 0, which no logarithm shows


def test_envelope_by_hand() -> None:
    middles, median, largest = envelope(
        np.array([0.0, 0.5, 0.9, 3.9, 4.0]), np.array([1.0, 5.0, 3.0, 2.0, 9.0]), 4
    )
    assert middles.tolist() == [0.5, 3.5]  # spans of one second; two of them are empty
    assert median.tolist() == [3.0, 5.5]
    assert largest.tolist() == [5.0, 9.0]


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "latency.png"
    draw(results(), path)
    assert not path.exists()
    nothing = replace(
        TRIAL, tick=np.array([], np.int64), loop_ns=np.array([], np.int64), was_missed=np.array([], bool)
    )
    draw(results(CELL, Cell(4.0, "none", nothing), Cell(8.0, "none", TRIAL)), path)
    assert path.read_bytes()[:4] == b"\x89PNG" and path.stat().st_size > 20_000


def test_rates_are_typed_with_commas() -> None:
    assert parse_rates("500,100,500, 1e3") == (100.0, 500.0, 1000.0)
    for wrong in ("", "fast", "100,,200", "0", "-5", "nan", "inf"):
        with pytest.raises(ConfigError, match=r"^hz = "):
            parse_rates(wrong)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        (LatencyOptions(seconds=1.0), "seconds"),
        (LatencyOptions(seconds=float("nan")), "seconds"),
        (LatencyOptions(env="nowhere"), "preset"),
        (LatencyOptions(limit=0.0), "limit"),
        (LatencyOptions(limit=1.0), "limit"),
        (LatencyOptions(hz="2000000"), "env.hz"),
    ],
)
def test_wrong_options(options: LatencyOptions, field: str) -> None:
    with pytest.raises(ConfigError, match=f"^{field} = "):
        plan(options)


def test_defaults() -> None:
    assert plan(LatencyOptions()).rates == (100.0, 200.0, 500.0, 1000.0)
    assert plan(LatencyOptions()).loads == ("none", "learner")
    assert plan(LatencyOptions(hold_rate=True)).rates[-1] == 4000.0
    assert plan(LatencyOptions(load="none")).loads == ("none",)


def test_a_trial_saturates_the_learner_or_hardly_learns() -> None:
    base = presets.load("halfcheetah")
    loaded = trial_config(base, hz=500.0, load="learner", seconds=3.0, rt="off")
    idle = trial_config(base, hz=500.0, load="none", seconds=3.0, rt="off")
    assert loaded.learner.utd == 100.0 and idle.learner.utd == 1 / 500
    assert loaded.learner.learning_starts == 128  # as soon as there is a batch
    assert (loaded.env.hz, loaded.env.speed) == (500.0, 25.0)
    assert (loaded.agent.rt, loaded.duration_s, loaded.recorder.record) == ("off", 3.0, False)


def test_steal_and_processor_from_their_texts() -> None:
    assert steal_s("cpu  1 2 3 4 5 6 7 250 0 0\ncpu0 1\n", 100) == 2.5
    assert steal_s("cpu  1 2 3 4\n", 100) is None
    assert steal_s("", 100) is None
    assert processor("processor\t: 0\nmodel name\t: Some  CPU\n") == "Some CPU"


def test_the_real_command(tmp_path: Path) -> None:
    out = tmp_path / "here" / "results"
    done = tenuto(
        "latency",
        "--hz",
        "50",
        "--load",
        "none",
        "--seconds",
        "1.5",
        "--out",
        str(out),
        cwd=tmp_path,
        timeout_s=50,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert {path.name for path in out.iterdir()} == {"latency.json", "latency.png"}
    assert set(tmp_path.iterdir()) == {tmp_path / "here"}
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


def test_the_real_search(tmp_path: Path) -> None:
    arguments = ["--hold-rate", "--hz", "50", "--load", "none", "--limit", "0.3", "--out", "results"]
    done = tenuto("latency", *arguments, cwd=tmp_path, timeout_s=50)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "results" / "latency.json").read_text())
    first, *_ = attempts = found["hold_rate"]["attempts"]
    assert found["hold_rate"]["ended"] and found["cells"] == []
    assert first["counted"]["ticks"] == 9  # ln 0.05 / ln 0.7 = 8.4: no longer than the confirmation
    assert [attempt["stage"] for attempt in attempts] == ["screening", "confirmation"][: len(attempts)]
    assert (found["hold_rate"]["established_hz"] == 50.0) == (len(attempts) == 2 and attempts[1]["passed"])
    assert "50 Hz" in done.stdout and not (tmp_path / "results" / "latency.png").exists()


def wait_for_ticks(temporary: Path, process: subprocess.Popen[str], limit_s: float = 40.0) -> None:
    """Until the env server of the trial below `temporary` says that it ticks."""
    deadline = time.monotonic() + limit_s
    while not any(" Hz" in log.read_text() for log in temporary.glob("*/run/logs/env_server.jsonl")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)


def test_ctrl_c_keeps_what_is_there(tmp_path: Path) -> None:
    arguments = ["latency", "--hz", "50", "--load", "none", "--seconds", "60", "--out", "results"]
    command = ["env", f"TMPDIR={tmp_path}", *command_line(*arguments)]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        wait_for_ticks(tmp_path, process)
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=20)
    assert process.returncode == 0, said
    assert {path.name for path in tmp_path.iterdir()} == {"results"}
    found = json.loads((tmp_path / "results" / "latency.json").read_text())
    (cell,) = found["cells"]
    assert found["interrupted"] and cell["system"]["interrupted"] and cell["echo"] == {}
    assert 0 < cell["system"]["ticks"] < 3000
    assert "interrupted before its time" in said


def test_wrong_input_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    for arguments, word in ((["--hz", "fast"], "hz = 'fast'"), (["--out", "taken"], "out = 'taken'")):
        done = tenuto("latency", *arguments, cwd=tmp_path)
        assert done.returncode == 2
        assert done.stderr.startswith(f"tenuto: {word}") and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == [tmp_path / "taken"]
