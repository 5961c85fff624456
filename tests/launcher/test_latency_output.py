"""`tenuto latency`: its tables, its JSON and its picture, of made-up results."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from launcher.latency.picture import draw, envelope, survival
from launcher.latency.results import Cell, as_json
from launcher.latency.table import cell_table, overview, remarks
from tests.launcher.latency_results import CELL, TRIAL, results


def text_of(*renderables: Any) -> str:
    console = Console(file=io.StringIO(), width=100, color_system=None)
    for renderable in renderables:
        console.print(renderable)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


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
