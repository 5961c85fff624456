"""The soak's verdicts from made-up runs, and a second of a real one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks import soak
from benchmarks.memory import Sample
from benchmarks.soak import Arguments, Trend, accounts, configure, judged, problems, table, trend, verdict
from rtcore import cast

MB = 1_000_000
ENV = {
    "ticks": 1990, "resets": 2, "missed": 3, "overruns": 1, "skipped": 10, "down": 0, "produced": 1988,
    "learned": 1988, "lost": 0, "duplicate": 0, "mean_return": -1.0,
}  # fmt: skip


def summary(**changes: Any) -> dict[str, Any]:
    """Two environments, 2000 deadlines each, nothing lost."""
    found = {
        "ended": "duration",
        "ticks": 3980,
        "resets": 4,
        "deadlines": {"missed": 6, "skipped": 20, "down": 0},
        "transitions": {"produced": 3976, "learned": 3976, "lost": 0, "duplicate": 0},
        "learner": {"gradient_steps": 30},
        "recorder": {"rows": 9000, "dropped": 0},
        "disk": {"transitions": 0, "rows": 0},
        "messages": {"rejected": 0, "denied": 0},
        "restarts": {"env_server": 0, "learner": 0},
        "supervision": [{"at_s": 1.0, "process": "learner", "what": "starved", "code": None}],
        "forced": [],
        "envs": {"env0": dict(ENV), "env1": dict(ENV)},
    }
    return found | changes


@pytest.fixture(autouse=True)
def reconciled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The made-up summary has no more of a summary than is read here."""
    monkeypatch.setattr(soak, "discrepancies", lambda summary: summary.get("odd", []))


def of(own: list[float], mapped: float = 0.0) -> list[Sample]:
    """A sample in the middle of each twentieth of an hour, in MB."""
    return [
        Sample(100 + 180 * (i + 0.5), round(mb * MB), round((mb + mapped) * MB)) for i, mb in enumerate(own)
    ]


def test_a_line_has_its_own_slope_and_no_width() -> None:
    # 100 MB and 6 MB/h, a twentieth of an hour apart; a tenth of the hour is between samples 1 and 2
    found = trend(of([100 + 6 * (i + 0.5) / 20 for i in range(20)], mapped=7.0), 100, 3700)
    assert found.slope_mb_h == pytest.approx(6.0)
    assert [found.low_mb_h, found.high_mb_h] == pytest.approx([6.0, 6.0])
    assert found.early_mb == pytest.approx(100 + 6 / 10)
    assert found.last_mb == pytest.approx(100 + 6 * 19.5 / 20)
    assert found.mapped_mb == pytest.approx(7.0)
    assert found.grown == pytest.approx(6 * 9 / 20 / (100 + 6 * 10.5 / 20))


def test_the_interval_is_from_the_second_lowest_step_to_the_second_highest() -> None:
    """Nine steps between blocks of 0.05 h, in MB: -5, -2, -1, 0, 1, 2, 3, 4, 9, in another order."""
    steps = [1, -5, 9, 2, 0, -2, 4, 3, -1]
    found = trend(of([500.0] * 10 + [100.0 + sum(steps[:i]) for i in range(10)]), 100, 3700)
    assert (found.slope_mb_h, found.low_mb_h, found.high_mb_h) == pytest.approx((20.0, -40.0, 80.0))
    assert found.grown == pytest.approx(0.11)


def test_what_an_allocator_once_takes_is_no_slope() -> None:
    found = trend(of([100.0] * 15 + [102.0] * 5), 100, 3700)
    assert (found.slope_mb_h, found.low_mb_h, found.high_mb_h) == (0.0, 0.0, 0.0)
    assert found.grown == pytest.approx(0.02)
    assert verdict(found, 3600.0) == "flat"
    assert verdict(trend(of([100.0] * 15 + [104.0] * 5), 100, 3700), 3600.0) == "grows"


def test_samples_beside_the_run_do_not_count() -> None:
    beside = [Sample(50.0, 900 * MB, 900 * MB), *of([100.0] * 20), Sample(3800.0, 900 * MB, 900 * MB)]
    found = trend(beside, 100, 3700)
    assert found.slope_mb_h == pytest.approx(0.0, abs=1e-9)
    assert found.last_mb == 100.0


def test_a_moments_memory_does_not_count() -> None:
    """Three samples to a block, of which one is a spike, higher in every block."""
    flat = of([100.0] * 20)
    beside = [replace(one, at_s=one.at_s + 10) for one in flat]
    spikes = [replace(one, at_s=one.at_s + 20, own=one.own + i * MB) for i, one in enumerate(flat)]
    found = trend([*flat, *beside, *spikes], 100, 3700)
    assert (found.slope_mb_h, found.low_mb_h, found.high_mb_h, found.grown) == (0.0, 0.0, 0.0, 0.0)


def test_a_run_with_holes_is_not_judged() -> None:
    with pytest.raises(ValueError, match="19 samples: not one in each block"):
        trend(of([100.0] * 19), 100, 3700)


@pytest.mark.parametrize(
    ("low", "slope", "grown", "run_s", "told"),
    [
        (-9.0, 4.0, 0.03, 1680.0, "flat"),
        (4.0, 4.1, 0.03, 1680.0, "too short"),
        (4.1, 5.0, 0.0, 1680.0, "grows"),
        (-9.0, 0.0, 0.031, 1680.0, "grows"),
        (4.1, 5.0, 0.2, 1679.0, "too short"),
        (-1.0, 0.0, 0.0, 1679.0, "too short"),
    ],
)
def test_flat_and_growing(low: float, slope: float, grown: float, run_s: float, told: str) -> None:
    assert verdict(Trend(1.0, 1.0, 0.0, slope, low, 99.0, grown), run_s) == told


def test_a_run_without_losses_has_no_problems() -> None:
    assert problems(summary(), 2000) == []
    assert accounts(summary())["env1"] == {name: ENV[name] for name in ENV if name != "mean_return"}


def test_a_run_of_one_environment_is_its_own_account() -> None:
    alone = summary()
    del alone["envs"]
    assert accounts(alone | {"deadlines": alone["deadlines"] | {"overruns": 2}})["env"]["learned"] == 3976


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"envs": {"env0": ENV | {"lost": 1}}}, "env0: lost 1"),
        ({"envs": {"env0": ENV | {"down": 5, "ticks": 1985}}}, "env0: down 5"),
        ({"envs": {"env0": ENV | {"ticks": 1989}}}, "env0: 1999 of 2000 deadlines"),
        ({"recorder": {"rows": 1, "dropped": 2}}, "recorder dropped: 2"),
        ({"messages": {"rejected": 3, "denied": 0}}, "messages rejected: 3"),
        ({"messages": {"rejected": 0, "denied": 4}}, "messages denied: 4"),
        ({"disk": {"transitions": 5, "rows": 0}}, "not on disk, transitions: 5"),
        ({"restarts": {"learner": 1}}, "restarts of learner: 1"),
        ({"forced": ["recorder"]}, "killed at the end: 1"),
        ({"ended": "stopped"}, "ended: stopped"),
        ({"odd": ["1 != 2"]}, "1 != 2"),
    ],
)
def test_whatever_goes_wrong_is_told(changes: dict[str, Any], told: str) -> None:
    assert problems(summary(**changes), 2000) == [told]


def found(**changes: Any) -> dict[str, Any]:
    config = configure(Arguments(minutes=60.0))
    flat = {name: of([100.0] * 20) for name in ("launcher", *cast.names(config))}
    one = {
        "code": 0,
        "stolen_s": 0.0,
        "summary": summary(),
        "samples": flat,
        "t0_s": 100.0,
        "recording_mb": 3,
    }
    return one | changes


def test_the_result_has_a_verdict_for_everybody(monkeypatch: pytest.MonkeyPatch) -> None:
    config = configure(Arguments(minutes=60.0))
    monkeypatch.setattr(soak, "problems", lambda summary, num_ticks: [f"{num_ticks} deadlines"])
    told = judged(config, found())
    assert told["wrong"] == ["1800000 deadlines"]
    # 3600 s / 526 316 ns = 6 839 997.3, as the env server counts; duration times rate is 6 840 000
    assert judged(configure(Arguments(minutes=60.0, hz=1900.0)), found())["wrong"] == ["6839997 deadlines"]
    assert list(told["memory"]) == ["launcher", *cast.names(config)]
    assert {row["verdict"] for row in told["memory"].values()} == {"flat"}
    assert told["series"]["learner"][0] == [90.0, 100 * MB, 100 * MB]
    text = table(told)
    assert "agent_service.3" in text
    assert "silences for want of a core 1\n" in text
    assert text.endswith("1800000 deadlines")
    assert table(told | {"wrong": []}).endswith("nothing dropped, memory flat")
    told["memory"]["learner"]["verdict"] = "too short"
    assert table(told | {"wrong": []}).endswith("too short to tell whether memory is flat")
    json.dumps(told)


def test_who_grows_and_who_was_not_seen_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    config = configure(Arguments(minutes=60.0))
    monkeypatch.setattr(soak, "problems", lambda *_: [])
    samples = found()["samples"]
    grown = samples | {"env_server.1": of([100.0 + 5 * i / 20 for i in range(20)])}
    assert judged(config, found(samples=grown))["wrong"] == [
        "env_server.1 grows by 5.0 MB/h, 2.2% in the second half"
    ]
    gone = {name: one for name, one in samples.items() if name != "recorder"}
    assert judged(config, found(samples=gone))["wrong"] == [
        "recorder: 0 samples: not one in each block of the second half"
    ]
    assert judged(config, found(code=1))["wrong"] == ["tenuto run ended with code 1"]


def test_the_replay_is_full_early_and_something_is_learned() -> None:
    config = configure(Arguments())
    assert config.env.hz is not None
    a_second = config.env.count * config.env.hz
    assert config.learner.replay_capacity / a_second <= 60
    assert 60 * a_second * config.learner.utd > 100  # gradient steps a minute
    assert config.recorder.record


def test_a_second_of_a_real_run(tmp_path: Path) -> None:
    config = replace(configure(Arguments(count=1, hz=100.0, rt="off")), duration_s=1.0)
    told = soak.soak(config, tmp_path / "run")
    assert told["code"] == 0
    assert problems(told["summary"], 100) == []
    assert set(told["samples"]) == {"launcher", *cast.names(config)}
    for taken in told["samples"].values():
        most = max(taken, key=lambda one: one.own)
        assert most.resident > most.own > 5 * MB
        assert all(one.resident for one in taken)
    assert told["recording_mb"] > 0
