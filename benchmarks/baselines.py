"""What did a run learn? Its returns beside a random and a standing-still policy in the same world.

    python -m benchmarks.baselines runs/<run> [runs/<run> ...]

The two policies live through the run's own timetable: the same episodes' lengths at the same units, so
at the same targets. Only the initial noise of the episodes differs. Returns are per tick; for worlds
whose episodes all have the same length, and for runs of one environment: a fleet's returns are told
environment by environment, which is no course of time.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from env_server.worlds.registry import make_world
from env_server.worlds.world import Vector, World
from rtcore.config import RunConfig
from rtcore.run_dir import RunDir

PARTS = 10  # the run is told in so many parts of equal length
BASELINE_SEED = 1_000_003  # apart from the run's own


@dataclass(frozen=True)
class Arguments:
    """Which runs."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    out: Path | None = Path("benchmarks/results")


def baseline(
    config: RunConfig, choose: Callable[[World, np.random.Generator], Vector], ticks: int
) -> list[float]:
    """Returns per tick, one an episode, of a policy that does not look, over so many ticks."""
    env = config.env
    assert env.hz is not None
    rng = np.random.default_rng(BASELINE_SEED)
    world = make_world(env, BASELINE_SEED)
    found: list[float] = []
    total, length, reset = 0.0, 0, True
    for tick in range(ticks):
        unit = int(tick / env.hz / env.unit_s)
        if reset:
            world.reset(None if tick else BASELINE_SEED, unit)
            total, length, reset = 0.0, 0, False
            continue
        outcome = world.step(choose(world, rng), unit)
        total, length = total + outcome.reward, length + 1
        if outcome.terminated or outcome.truncated or length == env.episode_steps:
            found.append(total / length)
            reset = True
    world.close()
    return found


def uniform(world: World, rng: np.random.Generator) -> Vector:
    """pi_0."""
    return rng.uniform(world.action_low, world.action_high).astype(np.float32)


def still(world: World, rng: np.random.Generator) -> Vector:
    """No torque at all."""
    del rng
    return np.clip(np.zeros_like(world.action_low), world.action_low, world.action_high)


def parts(returns: list[float]) -> list[float]:
    """Means over equal parts of the run."""
    edges = np.linspace(0, len(returns), PARTS + 1).astype(int)
    return [statistics.fmean(returns[a:b]) for a, b in pairwise(edges)]


def compare(path: Path) -> dict[str, Any]:
    """The table of one run."""
    run_dir = RunDir.open(path)
    config = run_dir.config()
    if config.env.count > 1:
        raise SystemExit(f"{path}: {config.env.count} environments; needs a run of one")
    summary = json.loads(run_dir.summary_path.read_text())
    ticks = summary["ticks"] + summary["deadlines"]["skipped"]
    learned = [value / config.env.episode_steps for value in summary["returns"]]
    if len(learned) < PARTS:
        raise SystemExit(f"{path}: {len(learned)} episodes; needs {PARTS}")
    return {
        "run": run_dir.run_name,
        "algo": config.learner.algo,
        "seed": config.seed,
        "duration_s": config.duration_s,
        "learned": parts(learned),
        "random": parts(baseline(config, uniform, ticks)),
        "still": parts(baseline(config, still, ticks)),
    }


def main(arguments: Arguments) -> None:
    """Print the tables; write them if asked to."""
    tables = [compare(path) for path in arguments.runs]
    for table in tables:
        print(f"\n{table['run']}: {table['algo']}, seed {table['seed']}, {table['duration_s']:g} s")
        for name in ("learned", "random", "still"):
            half = statistics.fmean(table[name][PARTS // 2 :])
            cells = " ".join(f"{value:6.2f}" for value in table[name])
            print(f"  {name:8} {cells}   second half {half:6.2f}")
        gains = [a - b for a, b in zip(table["learned"], table["still"], strict=True)]
        last = statistics.fmean(gains[-3:])
        print(f"  over standing still: first part {gains[0]:+.2f}, last three parts {last:+.2f}")
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        target = arguments.out / f"{datetime.now(UTC):%Y-%m-%d}-baselines.json"
        target.write_text(json.dumps(tables, indent=1) + "\n")
        print(f"\nwritten to {target}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
