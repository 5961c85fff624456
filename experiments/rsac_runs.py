"""One run of the `rsac` comparison: `pointmass` through the real services, in virtual time."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

from env_server.worlds.registry import resolve
from experiments.presets import pointmass
from launcher.sim import simulate
from rtcore.config import DriftConfig, LearnerConfig, RewardModelConfig, RunConfig, ScheduleConfig
from rtcore.lifecycle import Stop
from rtcore.run_dir import RunDir

TICKS = 40  # per unit: the reset and 39 steps, so that an episode is a unit and its target is constant
UPDATES_PER_STEP = 0.41  # 16 per unit
UNITS = 200

DRIFTS: Mapping[str, DriftConfig] = {
    "fast": DriftConfig(kind="sine", amplitude=1.0, omega=2 * math.pi / 60),
    "slow": DriftConfig(kind="sine", amplitude=1.0, omega=2 * math.pi / 240),
    "switch": DriftConfig(kind="switch", offset=-0.8, amplitude=1.6, every=40.0),
    "ramp": DriftConfig(kind="ramp", offset=-1.5, amplitude=3.3, span=200.0),
    "none": DriftConfig(kind="constant", offset=0.7),
}
COUNTED_FROM: Mapping[str, int] = {"none": 40}  # the first unit that is scored; 60 where not named

Forecast = Literal["best", "persistence", "line", "level", "ar"]


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run: the drift, the learner, the seed.

    Attributes:
        model: the reward model of `rsac`; "": plain SAC.
        replay: newest units to sample from; None: all.
        recency: mean age in units to sample by; None: uniformly.
        hold: units of every 5 in which the policy is held.
    """

    drift: str
    model: Literal["", "declared", "learned"] = ""
    forecast: Forecast = "best"
    alpha: float | Literal["auto"] = 0.1
    lr: float = 6e-3
    replay: float | None = None
    recency: float | None = None
    hold: int = 0
    seed: int = 0
    units: int = UNITS

    @property
    def key(self) -> str:
        """Names the job for good, for files."""
        return json.dumps(asdict(self), sort_keys=True)


def configure(job: Job) -> RunConfig:
    """The run's configuration: everything that is the same for all methods, and the job's own settings."""
    base = pointmass()
    env = replace(base.env, hz=float(TICKS), speed=None, episode_steps=TICKS - 1, drift=DRIFTS[job.drift])
    schedule = ScheduleConfig(l_f=5, gamma_f=(5 - job.hold) / 5) if job.hold else ScheduleConfig(l_f=1)
    learner = LearnerConfig(
        algo="rsac" if job.model else "sac",
        hidden=(32, 32),
        batch=64,
        utd=UPDATES_PER_STEP,
        learning_starts=TICKS,
        gamma=0.9,
        tau=0.05,
        alpha=job.alpha,
        actor_lr=job.lr,
        critic_lr=job.lr,
        alpha_lr=job.lr,
        replay_units=job.replay,
        replay_recency=job.recency,
        replay_capacity=10_000,  # more than a run brings
        precision="float32",
        schedule=schedule,
        reward=RewardModelConfig(model=job.model or "declared", forecast=job.forecast),
    )
    return replace(
        base,
        seed=job.seed,
        duration_s=float(job.units),
        env=resolve(env),
        learner=learner,
        recorder=replace(base.recorder, record=False),
    )


def run(job: Job) -> list[float]:
    """Mean reward per tick of each unit."""
    config = configure(job)
    with tempfile.TemporaryDirectory() as directory:
        stats, _ = simulate(config, RunDir.create(Path(directory) / "run", config), Stop(), lambda _: None)
    returns = stats["env_server"][-1].returns
    assert [one.episode for one in returns] == list(range(job.units)), "an episode is a unit"
    return [one.value / one.length for one in returns]


def score(job: Job, rewards: list[float]) -> float:
    """Mean reward per tick over the units that count."""
    counted = rewards[COUNTED_FROM.get(job.drift, 60) :]
    return math.fsum(counted) / len(counted)


class Results:
    """Scores by job, kept in a file, so that an interrupted comparison goes on where it was."""

    def __init__(self, path: Path) -> None:
        """Reads `path` if it is there: a JSON object per line."""
        self._path = path
        self._scores: dict[str, float] = {}
        if path.is_file():
            for line in path.read_text().splitlines():
                self._scores |= json.loads(line)

    def __getitem__(self, job: Job) -> float:
        return self._scores[job.key]

    def __contains__(self, job: Job) -> bool:
        return job.key in self._scores

    def complete(self, jobs: Iterable[Job], workers: int) -> None:
        """Run those of `jobs` that have no score yet, in order, `workers` at a time."""
        missing = [job for job in dict.fromkeys(jobs) if job not in self]
        if not missing:
            return
        with (
            ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool,
            self._path.open("a") as file,
        ):
            pending = {pool.submit(run, job): job for job in missing}
            for done in as_completed(pending):
                job = pending[done]
                self._scores[job.key] = score(job, done.result())
                file.write(json.dumps({job.key: self._scores[job.key]}) + "\n")
                file.flush()
