"""The `rsac` comparison: its runs through the real services, and what is made of their scores."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.intervals import Interval
from experiments.rsac import METHODS, collect, compared, differences, held, table
from experiments.rsac_picture import draw
from experiments.rsac_runs import DRIFTS, UNITS, Job, Results, configure, run, score
from experiments.rsac_tuning import FINALISTS, MODELS, SEEDS, Model, grid, tune
from rtcore.config_check import check


def test_every_job_is_a_valid_run() -> None:
    jobs = [job for drift in DRIFTS for model in MODELS for job in grid(drift, model)]
    for job in [*jobs, replace(jobs[0], hold=4)]:
        config = configure(job)
        check(config)
        assert config.env.hz is not None
        assert config.env.hz * config.env.unit_s == config.env.episode_steps + 1
    held_config = configure(replace(jobs[0], hold=4)).learner.schedule
    assert held_config.l_f == 5
    assert held_config.gamma_f == pytest.approx(0.2)
    assert not {job.seed for job in jobs} & set(range(10))


@pytest.mark.parametrize("model", ["declared", "learned"])
def test_the_same_job_gives_the_same_rewards(model: Model) -> None:
    job = Job(drift="fast", model=model, units=5)
    rewards = run(job)
    assert len(rewards) == 5
    assert run(job) == rewards
    assert run(replace(job, seed=1)) != rewards


def test_a_score_counts_from_unit_60_or_40() -> None:
    rewards = [0.0] * 60 + [1.0, 3.0]
    assert score(Job(drift="fast"), rewards) == 2.0
    assert score(Job(drift="none"), rewards) == pytest.approx(4 / 22)


class Made(Results):
    """Scores out of thin air: the larger alpha the better, but with SAC's later seeds the smaller."""

    def __init__(self) -> None:
        self.ran: list[Job] = []

    def __contains__(self, job: Job) -> bool:
        return job in self.ran

    def __getitem__(self, job: Job) -> float:
        assert job in self.ran
        alpha = 0.0 if job.alpha == "auto" else job.alpha
        return alpha if job.seed == SEEDS[0] else -alpha

    def complete(self, jobs: Iterable[Job], workers: int) -> None:
        self.ran += jobs


def test_sac_is_chosen_among_its_finalists_on_every_seed() -> None:
    results = Made()
    chosen = tune(results, 1)
    assert set(chosen) == {(drift, model) for drift in DRIFTS for model in MODELS}
    # Finalists 0.2 and some with 0.1; over three seeds, 0.2 - 2 * 0.2 is worse than 0.1 - 2 * 0.1.
    assert chosen["fast", ""].alpha == 0.1
    assert chosen["fast", "declared"].alpha == 0.1  # by its one seed
    again = [job for job in results.ran if job.seed != SEEDS[0]]
    assert len(again) == len(DRIFTS) * FINALISTS * 2
    assert {job.model for job in again} == {""}


def test_the_methods_differ_in_what_they_should() -> None:
    chosen = {
        (drift, model): Job(drift=drift, model=model, alpha=0.02, seed=100, units=120)
        for drift in DRIFTS
        for model in MODELS
    }
    jobs = compared(chosen, 7)
    assert len(jobs) == len(DRIFTS) * len(METHODS)
    alone, forecast = jobs["fast", "learned, relabelled"], jobs["fast", "learned, forecast"]
    assert (alone.forecast, forecast.forecast) == ("persistence", "best")
    assert replace(alone, forecast="best") == forecast
    assert {(job.seed, job.units) for job in jobs.values()} == {(7, UNITS)}
    assert {job.hold for job in held(chosen, 7).values()} == {4}


def test_differences_are_paired_by_seed(tmp_path: Path) -> None:
    methods = list(METHODS)
    scores = {drift: {name: [1.0 * k, 2.0 + k] for k, name in enumerate(methods)} for drift in DRIFTS}
    found = differences(scores)
    # The seeds differ by 2, the methods by 1 on each seed: no interval is left.
    assert found["fast"]["declared, forecast - SAC"] == Interval(2.0, 0.0)
    assert found["fast"]["learned, forecast - learned, relabelled"] == Interval(1.0, 0.0)
    assert "+2.000 ± 0.000" in table(scores)
    draw(tmp_path / "rsac.png", {"always": found, "held": found})
    assert (tmp_path / "rsac.png").stat().st_size > 10_000


def test_results_outlive_the_process(tmp_path: Path) -> None:
    job = Job(drift="none", units=41)
    Results(tmp_path / "runs.jsonl").complete([job, job], 1)
    again = Results(tmp_path / "runs.jsonl")
    assert job in again
    assert np.isfinite(again[job])
    assert replace(job, seed=1) not in again
    assert collect(again, [{("none", "SAC"): job}]) == {"none": {"SAC": [again[job]]}}
