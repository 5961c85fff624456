"""Does Tenuto's SAC learn as well as stable-baselines3's? Pendulum-v1, virtual time, equal settings.

    python -m benchmarks.sac_pendulum --seeds 5 --steps 10000

Both make one update per step after the same random start, with the same networks, rates and batch.
What differs: Tenuto's agent acts on the policy published at the end of the last unit (here 0.25 s, 5
steps), and a reset takes a tick. A seed's score is the mean return of its last 10 training episodes,
with sampled actions on both sides.
"""

from __future__ import annotations

import json
import math
import statistics
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import stable_baselines3
import torch
import tyro
from stable_baselines3.common.monitor import Monitor

from experiments.intervals import interval
from experiments.presets import gym
from launcher.sim import simulate
from rtcore.config import LearnerConfig, Precision, RunConfig
from rtcore.lifecycle import Stop
from rtcore.run_dir import RunDir

EPISODE_STEPS = 200
LAST_EPISODES = 10


@dataclass(frozen=True)
class Arguments:
    """What to compare."""

    steps: int = 10_000
    seeds: int = 5
    jobs: int = 2
    precision: Precision = LearnerConfig().precision  # of Tenuto's products
    out: Path = Path("benchmarks/results")


def tenuto_config(seed: int, steps: int, precision: Precision) -> RunConfig:
    """The `gym` preset for so many steps, with the settings that both sides share."""
    base = gym()
    env = replace(base.env, id="Pendulum-v1", hz=20.0, speed=1.0, episode_steps=EPISODE_STEPS, unit_s=0.25)
    learner = replace(
        base.learner,
        algo="sac", utd=1.0, learning_starts=100, hidden=(256, 256), batch=256, gamma=0.99, tau=0.005,
        actor_lr=1e-3, critic_lr=1e-3, alpha="auto", alpha_lr=1e-3, replay_units=None, precision=precision,
        schedule=replace(base.learner.schedule, kind="fixed", l_f=10, gamma_f=1.0),
    )  # fmt: skip
    ticks = steps + math.ceil(steps / EPISODE_STEPS)  # a reset is a tick of its own
    return replace(
        base,
        seed=seed,
        duration_s=ticks / 20.0,
        env=env,
        learner=learner,
        recorder=replace(base.recorder, record=False),
    )


def tenuto_returns(seed: int, steps: int, precision: Precision) -> list[float]:
    """Training returns of one seed of Tenuto's `sim`."""
    config = tenuto_config(seed, steps, precision)
    with tempfile.TemporaryDirectory() as directory:
        run_dir = RunDir.create(Path(directory) / "run", config)
        stats, _ = simulate(config, run_dir, Stop(), lambda _: None)
    return [episode.value for episode in stats["env_server"][-1].returns]


def sb3_returns(seed: int, steps: int) -> list[float]:
    """Training returns of one seed of stable-baselines3."""
    torch.set_num_threads(1)
    learner = tenuto_config(seed, steps, LearnerConfig().precision).learner
    env = Monitor(gymnasium.make("Pendulum-v1"))
    model = stable_baselines3.SAC(
        "MlpPolicy", env, learning_rate=learner.actor_lr, learning_starts=learner.learning_starts,
        batch_size=learner.batch, tau=learner.tau, gamma=learner.gamma, train_freq=1, gradient_steps=1,
        policy_kwargs={"net_arch": list(learner.hidden)}, seed=seed, device="cpu",
    )  # fmt: skip
    model.learn(steps)
    return list(env.get_episode_rewards())


def score(returns: list[float]) -> float:
    """Mean return of the last episodes."""
    return statistics.fmean(returns[-LAST_EPISODES:])


def compare(ours: list[float], theirs: list[float]) -> dict[str, float]:
    """Mean difference and its 95 % Student interval, paired by seed."""
    differences = [a - b for a, b in zip(ours, theirs, strict=True)]
    of_seeds = interval(differences)
    mean, half = of_seeds.mean, of_seeds.half
    return {"difference": mean, "low": mean - half, "high": mean + half}


def main(arguments: Arguments) -> None:
    """Run both on every seed, print the table, write the result."""
    if arguments.seeds < 2:
        raise SystemExit(f"seeds = {arguments.seeds}: must be 2 or more, for an interval")
    seeds = range(arguments.seeds)
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        ours_runs = [
            pool.submit(tenuto_returns, seed, arguments.steps, arguments.precision) for seed in seeds
        ]
        their_runs = [pool.submit(sb3_returns, seed, arguments.steps) for seed in seeds]
        ours = [run.result() for run in ours_runs]
        theirs = [run.result() for run in their_runs]
    found: dict[str, Any] = {
        "benchmark": "sac_pendulum",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "steps": arguments.steps,
        "precision": arguments.precision,
        "versions": {"torch": torch.__version__, "stable_baselines3": stable_baselines3.__version__},
        "tenuto": [score(r) for r in ours],
        "stable_baselines3": [score(r) for r in theirs],
        "returns": {"tenuto": ours, "stable_baselines3": theirs},
    }
    found |= compare(found["tenuto"], found["stable_baselines3"])
    print(f"{'seed':>4} {'tenuto':>10} {'sb3':>10}   (mean return of the last {LAST_EPISODES} episodes)")
    for seed in seeds:
        print(f"{seed:>4} {found['tenuto'][seed]:>10.1f} {found['stable_baselines3'][seed]:>10.1f}")
    print(f"difference {found['difference']:+.1f}, 95 % interval [{found['low']:+.1f}, {found['high']:+.1f}]")
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{datetime.now(UTC):%Y-%m-%d}-sac_pendulum.json"
    path.write_text(json.dumps(found, indent=1) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
