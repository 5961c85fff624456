"""`tenuto latency`: its figures, and what its options plan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from launcher import presets
from launcher.latency.command import LatencyOptions, judged, parse_rates, plan
from launcher.latency.hold_rate import Counted
from launcher.latency.trial import Series, trial_config
from launcher.machine import processor
from launcher.quantiles import quantiles_us
from launcher.stealing import steal_s
from rtcore.config import ConfigError
from tests.launcher.latency_results import CELL, TRIAL
from tests.rtcore.steps import make_step


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


def test_one_pair_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    one = presets.load("pointmass")
    monkeypatch.setattr(presets, "load", lambda name: replace(one, env=replace(one.env, count=3)))
    with pytest.raises(ConfigError) as caught:
        plan(LatencyOptions(env="three"))
    assert str(caught.value) == "env = 'three': must be a preset of one environment: its env.count is 3"


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
