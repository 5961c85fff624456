"""Results of `tenuto latency`, made up: one trial, the echo beside it, and the cell of both."""

from __future__ import annotations

import numpy as np

from launcher.echo.measure import EchoResult
from launcher.latency.results import Cell, Results
from launcher.latency.trial import Trial

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
