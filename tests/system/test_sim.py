"""The whole system in virtual time: the same seed is the same run, to the bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import safetensors.numpy

from env_server.worlds.registry import resolve
from experiments.presets import pointmass
from launcher.sim import simulate
from launcher.summary import Summary, discrepancies, summarise
from learner.resume import CHECKPOINT_DIR
from rtcore.config import ForecastConfig, RunConfig, ScheduleConfig
from rtcore.lifecycle import Stop
from rtcore.run_dir import RunDir


def small(seed: int = 7, **learner: Any) -> RunConfig:
    """Half a minute of point mass: 5 windows of 3 + 2 units (1 s, 40 ticks)."""
    base = pointmass()
    env = resolve(replace(base.env, hz=40.0, speed=None, episode_steps=50, unit_s=1.0))
    settings: dict[str, Any] = {
        "hidden": (16, 16), "batch": 32, "learning_starts": 100, "utd": 1.0,
        "schedule": ScheduleConfig(l_f=5, gamma_f=0.6),
    }  # fmt: skip
    return replace(
        base,
        seed=seed,
        duration_s=25.0,
        env=env,
        learner=replace(base.learner, **(settings | learner)),
        recorder=replace(base.recorder, record=False),
    )


def run(path: Path, config: RunConfig) -> tuple[Summary, bytes]:
    """The summary, wall time aside, and the learner's final weights."""
    run_dir = RunDir.create(path, config)
    stats, _ = simulate(config, run_dir, Stop(), lambda _: None)
    summary = summarise(config, "run", stats, wall_s=0.0, restarts={})
    (weights,) = (run_dir.learner_dir / CHECKPOINT_DIR).glob("*.safetensors")
    return summary, weights.read_bytes()


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Summary, bytes]:
    return run(tmp_path_factory.mktemp("sim") / "run", small())


def test_the_same_seed_gives_equal_bytes_and_equal_summaries(
    once: tuple[Summary, bytes], tmp_path: Path
) -> None:
    summary, weights = run(tmp_path / "again", small())
    assert weights == once[1]
    assert summary == once[0]


def test_another_seed_differs(once: tuple[Summary, bytes], tmp_path: Path) -> None:
    summary, weights = run(tmp_path / "other", small(seed=8))
    assert weights != once[1]
    assert summary["returns"] != once[0]["returns"]


def test_the_counts_by_hand(once: tuple[Summary, bytes]) -> None:
    """1000 ticks; an episode is a reset and 50 steps, so 20 resets (the last at tick 969)."""
    summary = once[0]
    assert discrepancies(summary) == []
    assert (summary["ticks"], summary["resets"], summary["episodes"]) == (1000, 20, 19)
    assert summary["transitions"] == {"produced": 980, "learned": 980, "lost": 0, "duplicate": 0}
    assert summary["learner"]["gradient_steps"] == 880
    assert summary["windows"] == [{"m": m, "t_m": 5 * m, "G": 3, "N": 2} for m in range(5)]
    assert summary["deadlines"]["missed"] == 0
    # 5 windows of 3 iterates; nothing has been learned yet in units 0 and 1 (100 transitions are 2.5 s)
    assert summary["policies"]["published"] == 13
    assert summary["policies"]["adopted"] == 13
    assert summary["policies"]["published_in_hold"] == 0


def test_fsac_without_forecast_and_without_hold_is_sac_to_the_bit(tmp_path: Path) -> None:
    always = ScheduleConfig(l_f=5, gamma_f=1.0)
    plain = run(tmp_path / "sac", small(algo="sac", schedule=always))
    forecasting_off = run(
        tmp_path / "fsac", small(algo="fsac", schedule=always, forecast=ForecastConfig(kind="none"))
    )
    assert forecasting_off[0]["returns"] == plain[0]["returns"]
    assert_equal_networks(forecasting_off[1], plain[1])


def assert_equal_networks(one: bytes, other: bytes) -> None:
    left, right = safetensors.numpy.load(one), safetensors.numpy.load(other)
    shared = left.keys() & right.keys()
    assert {name.split("/")[0].split(".")[0] for name in shared} >= {"actor", "critic", "target"}
    for name in shared:
        assert left[name].tobytes() == right[name].tobytes(), name


def test_with_the_forecast_it_is_not_sac(tmp_path: Path) -> None:
    schedule = ScheduleConfig(l_f=5, gamma_f=0.6)
    plain = run(tmp_path / "sac", small(algo="sac", schedule=schedule))
    forecasting = run(tmp_path / "fsac", small(algo="fsac", schedule=schedule))
    assert forecasting[0]["returns"] != plain[0]["returns"]
    assert forecasting[0]["forecast"]["windows"] == 3  # window 0 has no past; the last is not over


def test_it_learns_to_follow(tmp_path: Path) -> None:
    """Two minutes of point mass: the last episodes beat the first ones, which pi_0 acted, by far."""
    preset = pointmass()
    learner = replace(preset.learner, hidden=(32, 32), batch=64)
    config = replace(small(), duration_s=120.0, learner=learner)
    returns = run(tmp_path / "long", config)[0]["returns"]
    assert fmean(returns[-20:]) > 0.6 * fmean(returns[:3])  # returns are negative
