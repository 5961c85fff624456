"""Which learner settings make the `halfcheetah` preset? One change at a time, in virtual time.

    python -m benchmarks.halfcheetah_settings --seeds 3

Each run is the preset's two minutes (24 000 ticks, two updates a tick). The score is the mean reward
per tick over the last half of the run, a whole swing of the target; standing still is in the table.
"""

from __future__ import annotations

import json
import statistics
import tempfile
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import tyro

from benchmarks.baselines import baseline, still
from env_server.worlds.registry import resolve
from experiments.intervals import interval
from experiments.presets import halfcheetah
from launcher.sim import simulate
from rtcore.config import RunConfig, ScheduleConfig
from rtcore.lifecycle import Stop
from rtcore.run_dir import RunDir

CHANGES: Mapping[str, Mapping[str, Any]] = {
    "preset": {},
    "temperature 0.05": {"alpha": 0.05},
    "replay 15 units": {"replay_units": 15.0},
    "replay whole": {"replay_units": None},
    "no hold": {"schedule": ScheduleConfig(l_f=10, gamma_f=1.0)},
    "fsac": {"algo": "fsac"},
    "gamma 0.97": {"gamma": 0.97},
    "learning rates 1e-3": {"actor_lr": 1e-3, "critic_lr": 1e-3, "alpha_lr": 1e-3},
    "learning rates 3e-4": {"actor_lr": 3e-4, "critic_lr": 3e-4, "alpha_lr": 3e-4},
}


@dataclass(frozen=True)
class Arguments:
    """How much to run."""

    seeds: int = 3
    jobs: int = 2
    out: Path = Path("benchmarks/results")


def configure(change: str, seed: int) -> RunConfig:
    """The preset with one change."""
    base = halfcheetah()
    learner = replace(base.learner, **CHANGES[change])
    recorder = replace(base.recorder, record=False)
    return replace(base, seed=seed, env=resolve(base.env), learner=learner, recorder=recorder)


def score(change: str, seed: int) -> float:
    """Mean reward per tick over the last half of one run."""
    config = configure(change, seed)
    with tempfile.TemporaryDirectory() as directory:
        stats, _ = simulate(config, RunDir.create(Path(directory) / "run", config), Stop(), lambda _: None)
    return last_half([one.value / one.length for one in stats["env_server"][-1].returns])


def last_half(returns: list[float]) -> float:
    """Mean over the later half of the episodes."""
    return statistics.fmean(returns[len(returns) // 2 :])


def main(arguments: Arguments) -> None:
    """Run everything, print and write the table."""
    if arguments.seeds < 2:
        raise SystemExit(f"seeds = {arguments.seeds}: must be 2 or more, for an interval")
    seeds = range(arguments.seeds)
    preset = configure("preset", 0)
    floor = last_half(baseline(preset, still, round(preset.duration_s * (preset.env.hz or 0.0))))
    found: dict[str, list[float]] = {}
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        pending = {change: [pool.submit(score, change, seed) for seed in seeds] for change in CHANGES}
        for change, runs in pending.items():
            found[change] = [run.result() for run in runs]
            of_seeds = interval(found[change])
            scores = [round(one, 2) for one in found[change]]
            print(f"{change:22} {of_seeds.mean:6.2f} ± {of_seeds.half:4.2f}   {scores}", flush=True)
    print(f"{'standing still':22} {floor:6.2f}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{datetime.now(UTC):%Y-%m-%d}-halfcheetah_settings.json"
    path.write_text(json.dumps({"standing_still": floor, "scores": found}, indent=1) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
