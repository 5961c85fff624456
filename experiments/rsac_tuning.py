"""How SAC and `rsac` are tuned before they are compared: grids, per drift, on seeds of their own.

SAC gets the larger grid and the longer search, because a weak SAC makes every forecast look good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Literal

from experiments.rsac_runs import DRIFTS, Job, Results

Model = Literal["", "declared", "learned"]

SEEDS = (100, 101, 102)  # never among those that are compared
FINALISTS = 5  # of SAC's grid, by the first seed, get the other seeds too
UNITS = 120
MODELS: tuple[Model, ...] = ("", "declared", "learned")

Alpha = float | Literal["auto"]

_SHORTER = (1.0, 3.0, 10.0)  # replays of rsac in units, besides all of it
# Learning rates that did best on the whole replay, at a temperature of 0.02; shorter replays are tried there.
_LIKELY: dict[tuple[str, Model], tuple[float, ...]] = {
    ("fast", "declared"): (2e-3,),
    ("fast", "learned"): (6e-3,),
    ("slow", "declared"): (6e-3, 1.2e-2),
    ("slow", "learned"): (2e-3, 6e-3),
    ("switch", "declared"): (1.2e-2,),
    ("switch", "learned"): (6e-3,),
    ("ramp", "declared"): (6e-3, 1.2e-2),
    ("ramp", "learned"): (6e-3, 1.2e-2),
}

_RATES = (2e-3, 6e-3)
_ALPHAS: tuple[Alpha, ...] = (0.1, 0.05, 0.02, "auto")


def grid(drift: str, model: Model) -> list[Job]:
    """The settings that are tried, with the first seed."""
    first = Job(drift=drift, model=model, seed=SEEDS[0], units=UNITS)
    if model:
        beyond: dict[str, tuple[tuple[float, Alpha], ...]] = {
            "none": ((2e-3, 0.01), (2e-3, 0.005)),
            "slow": ((6e-3, 0.01), (1.2e-2, 0.02)),
            "switch": ((1.2e-2, 0.02),),
            "ramp": ((1.2e-2, 0.02),),
        }
        tried = [*product(_RATES, _alphas_of_rsac(drift, model)), *beyond.get(drift, ())]
        whole = [replace(first, alpha=alpha, lr=lr) for lr, alpha in tried]
        likely = _LIKELY.get((drift, model), ())
        return [*whole, *(replace(first, lr=lr, alpha=0.02, replay=n) for lr in likely for n in _SHORTER)]
    return [*_grid_of_sac(drift, first), *_beyond_the_edge(drift, first)]


def _alphas_of_rsac(drift: str, model: Model) -> tuple[Alpha, ...]:
    """All of SAC's for the declared model on the drifts where they matter most; 0.1 and "auto" lose there,
    0.05 on the others, and the later grids leave them out."""
    moving = drift in ("fast", "switch")
    if model == "declared":
        return _ALPHAS if moving else (0.05, 0.02)
    return (0.05, 0.02) if moving else (0.02,)


def _grid_of_sac(drift: str, first: Job) -> list[Job]:
    """The whole grid; on slow and ramp, which came last, without long replays."""
    settings = list(product(_RATES, _ALPHAS))
    replays: tuple[float | None, ...] = (1.0, 3.0, 10.0, None)
    if drift in ("slow", "ramp"):
        settings.remove((6e-3, "auto"))
        replays = (1.0, 3.0)
    return [replace(first, lr=lr, alpha=a, replay=units) for (lr, a), units in product(settings, replays)]


def _beyond_the_edge(drift: str, first: Job) -> list[Job]:
    """Steps further from the best of the grid, where that lies on its edge; and sampling by recency."""
    if drift == "none":
        return [replace(first, lr=2e-3, alpha=alpha) for alpha in (0.01, 0.005)]
    short = replace(first, replay=1.0)
    if drift in ("slow", "ramp"):
        alpha = 0.02 if drift == "slow" else 0.05
        further = [replace(short, lr=lr, alpha=alpha) for lr in (1.2e-2, 2.4e-2)]
        further += [replace(short, lr=1.2e-2, alpha=other) for other in (alpha / 2, 2 * alpha)]
        return [*further, replace(short, lr=6e-3, alpha=alpha / 2), replace(further[0], replay=3.0)]
    further = [
        replace(first, lr=6e-3, alpha=0.1, recency=1.0),
        replace(short, lr=6e-3, alpha=0.2),
        replace(short, lr=1.2e-2, alpha=0.1),
    ]
    if drift == "switch":
        further += [replace(short, lr=1.2e-2, alpha=0.05), replace(short, lr=2.4e-2, alpha=0.1)]
    return further


def tune(results: Results, workers: int) -> dict[tuple[str, Model], Job]:
    """The best settings of each drift and model, as the job with the first seed."""
    searches = {(drift, model): grid(drift, model) for drift, model in product(DRIFTS, MODELS)}
    results.complete((job for jobs in searches.values() for job in jobs), workers)
    # The rest of the search is SAC's alone: rsac keeps what one seed says.
    finals = {drift: _best(results, searches[drift, ""], FINALISTS) for drift in DRIFTS}
    results.complete((again for jobs in finals.values() for job in jobs for again in _seeds(job)), workers)
    chosen = {key: _best(results, jobs, 1)[0] for key, jobs in searches.items()}
    return chosen | {
        (drift, ""): max(jobs, key=lambda job: sum(results[again] for again in _seeds(job)))
        for drift, jobs in finals.items()
    }


def _best(results: Results, jobs: Sequence[Job], count: int) -> list[Job]:
    return sorted(jobs, key=lambda job: -results[job])[:count]


def _seeds(job: Job) -> list[Job]:
    return [replace(job, seed=seed) for seed in SEEDS]
