"""Regret from a diary, worked out by hand.

A chain of two states: action 0 goes left, 1 goes right, and leaving the end that pays earns 1. With
gamma = 1/2 and the right end paying, V* = (1, 2): go right, and stay. A policy that is uniform has
V0 = (V0 + V1) / 4 and V1 = 1 + (V0 + V1) / 4, so V = (1/2, 3/2) and loses 1/2 in each state. Always left
has V0 = 0 and V1 = 1, and loses (1, 1). Staying wherever it is has (0, 2), and loses (1, 0). When the left
end pays, always left is the best there is.
"""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console

from launcher import bounds, regret, report
from launcher.summary import summarise
from learner import diary
from learner.diary import Acted, ActedIn, Entered, Entry, Forecast, Published
from learner.tabular.table import npg_step
from learner.theory import certificates
from learner.theory.certificates import Case
from learner.theory.mdp import TimeElapsingMdp
from rtcore.config import DriftConfig, EnvConfig, LearnerConfig, MdpConfig, RunConfig, TableConfig
from rtcore.run_dir import RunDir
from tests.launcher.ledgers import CONFIG, whole_run

UNIT_NS = 1_000_000_000
LEFT, STAY = [[1, 0], [1, 0]], [[1, 0], [0, 1]]
CHAIN = RunConfig(
    env=EnvConfig(
        id="chain", hz=10.0, mdp=MdpConfig(states=2),
        drift=DriftConfig(kind="switch", offset=-1.0, amplitude=2.0, at=2.0),  # the left end, from unit 2 on
    ),
    learner=LearnerConfig(algo="npg", gamma=0.5, table=TableConfig(eta=2.0, entropy=0.1)),
)  # fmt: skip
PHASES: list[Entry] = [
    Entered(window=0, phase="hold", run_ns=UNIT_NS),  # as written, in any order
    Entered(window=0, phase="update", run_ns=0),
]


def published(version: int, table: Any) -> Published:
    data = np.array(table, "<f4").tobytes()
    return Published(version=version, window=0, iterate=1, created_ns=0, states=2, actions=2, table=data)


def acted(unit: int, ticks: dict[int, int], *, incarnation: int = 1) -> Acted:
    return Acted(incarnation=incarnation, next_seq=0, unit=unit, ticks=ticks)


def run_with(directory: Path, entries: list[Entry], config: RunConfig = CHAIN) -> dict[str, Any]:
    run_dir = RunDir.create(directory / "run", config)
    with (run_dir.learner_dir / diary.NAME).open("wb") as file:
        for entry in entries:
            body = msgspec.msgpack.encode(entry)
            file.write(len(body).to_bytes(4, "little") + body)
    return regret.of_run(config, run_dir)


LIVED: list[Entry] = [
    *PHASES,
    published(1, LEFT),
    published(2, STAY),
    acted(0, {0: 3}),
    acted(0, {1: 1}, incarnation=2),  # the env server came back in the same unit
    acted(1, {2: 2, -1: 5, 7: 1}),  # five misses, and a policy that is not in the diary
    acted(2, {1: 4}),
    acted(3, {-1: 10}),
]


def test_regret_by_hand(tmp_path: Path) -> None:
    """Unit 0: (3 * 1/2 + 1) / 4 = 5/8 from either start. Unit 1: (1 + 0) / 2, at worst 1. Unit 2: nothing."""
    found = run_with(tmp_path, LIVED)["regret"]
    assert {name: found[name] for name in ("units", "update_units", "hold_units")} == {
        "units": 3, "update_units": 1, "hold_units": 2,
    }  # fmt: skip
    assert (found["ticks"], found["left_out_ticks"]) == (10, 16)
    own = {name: found[name] for name in ("per_unit", "total", "update", "hold")}
    assert own == pytest.approx({"per_unit": 1.125 / 3, "total": 1.125, "update": 0.625, "hold": 0.5})
    worst = {"per_unit": 1.625 / 3, "total": 1.625, "update": 0.625, "hold": 1.0}
    assert found["worst_state"] == pytest.approx(worst)
    assert found["bounds"] is None
    assert found["bounds_missing"] == "no window was lived as scheduled, from its begin into the next one"


def test_a_units_regret_is_the_mean_over_the_ticks_of_all_environments(tmp_path: Path) -> None:
    """Unit 0: (3 * 1/2 + 1 + 1) / 5 = 7/10. Unit 1 as above, 4 ticks of the same policy."""
    of_another: list[Entry] = [
        ActedIn(incarnation=1, next_seq=9, unit=unit, ticks=ticks, env="env1")
        for unit, ticks in ((0, {1: 1}), (1, {2: 2}))
    ]
    fleet = replace(CHAIN, env=replace(CHAIN.env, count=2))
    found = run_with(tmp_path, [*LIVED, *of_another], fleet)["regret"]
    assert (found["units"], found["ticks"], found["left_out_ticks"]) == (3, 13, 16)
    assert {name: found[name] for name in ("total", "update", "hold")} == pytest.approx(
        {"total": 1.2, "update": 0.7, "hold": 0.5}
    )


def test_a_version_with_two_tables_is_left_out(tmp_path: Path) -> None:
    entries = [*LIVED, published(2, LEFT)]  # killed while it published, the learner came back
    found = run_with(tmp_path, entries)["regret"]
    assert (found["units"], found["left_out_ticks"]) == (2, 18)


@pytest.mark.parametrize(
    ("config", "why"),
    [
        (replace(CHAIN, env=EnvConfig(id="pointmass", hz=10.0)), "continuous"),
        (replace(CHAIN, env=replace(CHAIN.env, action_delay_ticks=1)), "action_delay_ticks"),
        (
            replace(CHAIN, learner=LearnerConfig(algo="q", gamma=1.0)),
            "learner.gamma = 1",
        ),
        (replace(CHAIN, env=replace(CHAIN.env, mdp=MdpConfig(states=600))), "too long"),
    ],
)
def test_why_there_is_none(config: RunConfig, why: str, tmp_path: Path) -> None:
    entries: list[Entry] = [acted(unit, {0: 1}) for unit in range(60)]
    if config.env.id == "pointmass":
        config = replace(config, learner=LearnerConfig())
    found = run_with(tmp_path, entries, config)
    assert found["regret"] is None
    assert why in found["regret_missing"]


def test_without_a_diary_there_is_none(tmp_path: Path) -> None:
    found = run_with(tmp_path, [])
    assert found == {
        "regret": None, "regret_missing": "the learner's diary has no tick of a known policy",
    }  # fmt: skip


# ---- bounds

FORECAST = np.array([[0.25, 1.5], [1.0, 2.5]])
START = np.log([[0.5, 0.5], [0.75, 0.25]])


def after(log_policy: np.ndarray, steps: int) -> np.ndarray:
    for _ in range(steps):
        log_policy = npg_step(log_policy, FORECAST, eta=2.0, entropy=0.1, gamma=0.5)
    return log_policy


def window(m: int, start: int, log_policy: np.ndarray, *, unit: int | None = None) -> Forecast:
    return Forecast(
        window=m, start=start, update=2, hold=1, unit=start if unit is None else unit, states=2, actions=2,
        forecast=FORECAST.astype("<f8").tobytes(), log_policy=log_policy.astype("<f8").tobytes(),
    )  # fmt: skip


def test_bounds_are_sums_over_the_windows_that_were_lived_as_scheduled(tmp_path: Path) -> None:
    """Windows 0 and 1 were; 2 was held by an operator, 3 was entered late, and 4 did not end."""
    windows: list[Entry] = [
        window(0, 0, START), window(1, 3, after(START, 2)), window(2, 6, after(START, 4)),
        window(3, 9, after(START, 5), unit=10), window(4, 12, after(START, 6)),
    ]  # fmt: skip
    found = run_with(tmp_path, [*LIVED, *windows])["regret"]["bounds"]
    right, left = (
        np.array([[0.0, 0], [1, 1]]),
        np.array([[1.0, 1], [0, 0]]),
    )  # the left end pays from unit 2 on
    moves = np.array([[[1.0, 0], [0, 1]], [[1, 0], [0, 1]]])
    cases = [
        Case(TimeElapsingMdp(np.stack(rewards), np.stack([moves] * 4), 0.5), 0, 2, 1, log, FORECAST, 2.0, 0.1)
        for rewards, log in (([right, right, left, left], START), ([left] * 4, after(START, 2)))
    ]
    assert (found["windows"], found["units"]) == (2, 6)
    lost = np.array([certificates.measured(case) for case in cases])
    parts = {"total": lost.sum(), "update": lost[:, :2].sum(), "hold": lost[:, 2:].sum()}
    assert found["iterates_worst_state"] == pytest.approx(parts, rel=1e-12)
    for name in ("printed", "repaired", "proven"):
        allowed = sum(getattr(certificates, name)(case).total for case in cases)
        assert found[name] == pytest.approx(allowed, rel=1e-12)
    assert found["gibbs"] == pytest.approx(sum(certificates.gibbs(case).sum() for case in cases), rel=1e-12)
    assert lost.sum() <= min(found["proven"], found["gibbs"])


@pytest.mark.parametrize(
    ("windows", "number"),
    [
        ([window(0, 0, START), window(1, 3, after(START, 2))], 1),
        ([window(0, 0, START), window(1, 3, after(START, 1))], 0),  # an iteration is missing
        ([window(0, 0, START, unit=1), window(1, 3, after(START, 2))], 0),  # entered late
        ([window(0, 0, START), window(1, 2, after(START, 2))], 0),  # cut short, by a change of the schedule
        ([window(0, 0, START)], 0),
    ],
)
def test_which_windows_are_complete(windows: list[Forecast], number: int) -> None:
    assert len(bounds.complete(windows, CHAIN.learner.table, CHAIN.learner.gamma)) == number


def test_other_algorithms_have_no_bounds(tmp_path: Path) -> None:
    reactive = replace(CHAIN, learner=LearnerConfig(algo="q", gamma=0.5))
    assert "Algorithm 1" in run_with(tmp_path, LIVED, reactive)["regret"]["bounds_missing"]


def test_many_windows_have_no_bounds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounds, "MOST_US", 2000)
    windows: list[Entry] = [window(0, 0, START), window(1, 3, after(START, 2))]
    found = run_with(tmp_path, [*LIVED, *windows])["regret"]
    assert (found["bounds"], found["bounds_missing"]) == (None, "1 windows of 2 states would take too long")


def test_the_end_of_an_episode_is_a_state_of_its_own() -> None:
    np.testing.assert_array_equal(bounds.with_end(np.ones((2, 2)), 3, 0.5), [[1, 1], [1, 1], [0.5, 0.5]])
    np.testing.assert_array_equal(bounds.with_end(np.ones((2, 2)), 2, 0.5), np.ones((2, 2)))


# ---- the report


def test_the_report_has_a_line(tmp_path: Path) -> None:
    summary = summarise(CONFIG, "r1", whole_run(), wall_s=4.5, restarts={}) | run_with(tmp_path, LIVED)
    said = StringIO()
    Console(width=100, file=said).print(report.render(summary, RunDir(tmp_path / "run")))
    assert "0.375 per unit (update 0.625, hold 0.250)" in said.getvalue()
