"""The run card says of a learner what its algorithm goes by, and nothing else."""

from __future__ import annotations

from typing import get_args

import pytest

from recorder.student import student_rows
from rtcore.config import Algo, ForecastConfig, LearnerConfig, ScheduleConfig, TableConfig

NETWORK = {"algorithm", "learning rate", "updates", "schedule", "in the hold", "forecast"}
TABLE = {"algorithm", "step size", "random actions", "schedule", "in the hold", "forecast"}
ROWS: dict[Algo, set[str]] = {
    "sac": NETWORK, "fsac": NETWORK, "rsac": NETWORK,
    "q": TABLE, "fq": TABLE, "npg": TABLE | {"policy's step"}, "tempo": {"algorithm", "schedule"},
}  # fmt: skip


@pytest.mark.parametrize("algo", get_args(Algo))
def test_each_algorithm_has_its_rows(algo: Algo) -> None:
    assert {name for name, _ in student_rows(LearnerConfig(algo=algo))} == ROWS[algo]


def test_what_the_rows_say() -> None:
    table = TableConfig(step_size=0.25, epsilon=0.05, eta=0.5, entropy=0.125, tempo_begin=3, tempo_span=4)
    forecast = ForecastConfig(l_p=7, trust="judged")
    npg = dict(student_rows(LearnerConfig(algo="npg", table=table, forecast=forecast)))
    assert npg["step size"] == "0.25, gamma 0.99"
    assert npg["random actions"] == "5 %"
    assert npg["policy's step"] == "eta 0.5, weight of the entropy 0.125"
    assert npg["in the hold"] == "Q learns: full"
    assert npg["forecast"] == "forq, 7 past tables, basis identity, horizon the window, trusted: judged"
    assert dict(student_rows(LearnerConfig(algo="q", forecast=forecast)))["forecast"] == "none"
    tempo = dict(student_rows(LearnerConfig(algo="tempo", table=table)))
    assert tempo["algorithm"].endswith("rises from 0 in unit 3 to 1 in unit 7")


def test_without_a_hold_nothing_is_said_of_it() -> None:
    rows = dict(student_rows(LearnerConfig(schedule=ScheduleConfig(l_f=1, gamma_f=1.0))))
    assert rows["schedule"] == "fixed: windows of 1 unit, without a hold"
    assert "in the hold" not in rows
