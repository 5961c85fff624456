"""The paper's motivating example (section 1): how fast should a policy change before a change to come?

    python -m experiments.motivation --seeds 20

Computes the expected average reward of linear ramps exactly, checks it against runs in virtual time of the
world `bandit` with the policies of `tempo`, and beside them lets Q-learning live through the same switches.
Prints the table, draws the picture, and writes the numbers down.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import tyro

from env_server.worlds.drift import make_drift
from env_server.worlds.registry import resolve
from experiments.finite_presets import bandit
from experiments.intervals import interval
from experiments.motivation_picture import draw
from experiments.ramps import Floats, Ramp, best_ramp, best_span, by_switch, rewards_given
from launcher.sim import simulate
from rtcore.config import LearnerConfig, RunConfig, TableConfig
from rtcore.lifecycle import Stop
from rtcore.run_dir import RunDir

UNITS = 120  # T
TICKS = 50  # per unit: 49 rewards and a reset
REWARDS = TICKS - 1
CONSERVATIVE, PESSIMISTIC = Ramp(begin=0, span=30), Ramp(begin=80, span=40)
UNIFORM = 0.5  # beta while the agent has no policy of the learner's: each arm as likely
SIDES = 1.96  # standard errors to each side of a 95 % interval, where the variance is known


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    seeds: int = 20
    jobs: int = 2
    picture: Path = Path("docs/motivation.png")
    out: Path = Path("benchmarks/results")


@dataclass(frozen=True)
class Exact:
    """Of a ramp, over all switches: mean, standard deviation and least of the average reward."""

    mean: float
    sd: float
    least: float


@dataclass(frozen=True)
class Run:
    """One run in virtual time."""

    first: int  # unit in which the arms are first swapped; T: never
    average: float  # reward per step


@dataclass(frozen=True)
class Check:
    """What runs earned less what their switches make exact, and half its 95 % interval."""

    excess: float
    half: float


@dataclass(frozen=True)
class Row:
    """One policy."""

    name: str
    ramp: Ramp | None
    exact: Exact | None
    runs: list[Run]
    check: Check | None


def exact(ramp: Ramp) -> Exact:
    """By exact sums over the switch's unit."""
    averages = by_switch(ramp.beta(UNITS))
    return Exact(float(averages.mean()), float(averages.std()), float(averages.min()))


def configure(ramp: Ramp | None, seed: int) -> RunConfig:
    """A run of T units, each an episode of its own; with Q-learning where there is no ramp."""
    base = bandit()
    learner: LearnerConfig = base.learner
    if ramp is not None:
        table = TableConfig(tempo_begin=ramp.begin, tempo_span=ramp.span)
        learner = replace(learner, algo="tempo", table=table)
    drift = replace(base.env.drift, kind="switch", at="random", amplitude=1.0, span=float(UNITS))
    env = replace(base.env, hz=float(TICKS), unit_s=1.0, episode_steps=REWARDS, drift=drift)
    recorder = replace(base.recorder, record=False)
    return replace(
        base, seed=seed, duration_s=float(UNITS), env=resolve(env), learner=learner, recorder=recorder
    )


def run(ramp: Ramp | None, seed: int) -> Run:
    """Live through one switch."""
    config = configure(ramp, seed)
    with tempfile.TemporaryDirectory() as directory:
        stats, _ = simulate(config, RunDir.create(Path(directory) / "run", config), Stop(), lambda _: None)
    episodes = stats["env_server"][-1].returns
    assert [one.length for one in episodes] == [REWARDS] * UNITS, "an episode is a unit"
    drift = make_drift(config.env.drift, seed)
    first = next((t for t in range(UNITS) if drift.value(t) > 0.5), UNITS)
    return Run(first, math.fsum(one.value for one in episodes) / (UNITS * REWARDS))


def check(ramp: Ramp, runs: Sequence[Run]) -> Check:
    """Compare runs with their expectation given their switches; what is left is the arms' own chance,
    whose variance is known: sum of r (1 - r) over the steps."""
    beta = acted(ramp)
    chances = [rewards_given(beta, run.first) for run in runs]
    excess = np.mean([run.average - chance.mean() for run, chance in zip(runs, chances, strict=True)])
    variance = sum(float((chance * (1 - chance)).mean()) for chance in chances) / (UNITS * REWARDS)
    return Check(float(excess), SIDES * math.sqrt(variance) / len(runs))


def acted(ramp: Ramp) -> Floats:
    """beta_t as the agent has it: the first policy comes at the end of the first unit."""
    beta = ramp.beta(UNITS)
    beta[0] = UNIFORM
    return beta


def policies() -> dict[str, Ramp | None]:
    """The paper's two, the slowest that arrives, the best that begins at once, the best, and a learner."""
    return {
        "conservative": CONSERVATIVE,
        "pessimistic": PESSIMISTIC,
        "from 0 to T": Ramp(0, UNITS),
        "best from 0": best_span(UNITS, 0),
        "best": best_ramp(UNITS),
        "Q-learning": None,
    }


def measure(seeds: int, jobs: int) -> list[Row]:
    """Every policy on every seed, `jobs` at a time."""
    found = policies()
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        futures = {
            name: [pool.submit(run, ramp, seed) for seed in range(seeds)] for name, ramp in found.items()
        }
        runs = {name: [future.result() for future in started] for name, started in futures.items()}
    return [
        Row(name, None, None, runs[name], None)
        if ramp is None
        else Row(name, ramp, exact(ramp), runs[name], check(ramp, runs[name]))
        for name, ramp in found.items()
    ]


def table(rows: Sequence[Row]) -> str:
    """For people."""
    lines = [f"{'':14}{'begin':>6}{'span':>6}{'mean':>8}{'sd':>7}{'least':>7}   runs' mean       less exact"]
    for row in rows:
        seen = interval([run.average for run in row.runs])
        middle = " " * 34
        if row.ramp is not None and row.exact is not None:
            numbers = f"{row.exact.mean:8.4f}{row.exact.sd:7.3f}{row.exact.least:7.3f}"
            middle = f"{row.ramp.begin:6}{row.ramp.span:6}{numbers}"
        last = "" if row.check is None else f"   {row.check.excess:+.4f} ± {row.check.half:.4f}"
        lines.append(f"{row.name:14}{middle}   {seen.mean:.3f} ± {seen.half:.3f}{last}")
    return "\n".join(lines)


def main(arguments: Arguments) -> None:
    """Measure, print, draw, and write down.

    Raises:
        SystemExit: fewer than two seeds give no interval.
    """
    if arguments.seeds < 2:
        raise SystemExit(f"seeds = {arguments.seeds}: must be 2 or more")
    rows = measure(arguments.seeds, arguments.jobs)
    print(table(rows))
    ramps = {row.name: row.ramp for row in rows if row.ramp is not None}
    points = {row.name: (row.exact.mean + row.check.excess, row.check.half) for row in rows
              if row.exact is not None and row.check is not None}  # fmt: skip
    draw(arguments.picture, UNITS, ramps, points)
    found = {
        "experiment": "motivation",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "units": UNITS,
        "steps": REWARDS,
        "rows": [asdict(row) for row in rows],
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{datetime.now(UTC):%Y-%m-%d}-motivation.json"
    path.write_text(json.dumps(found, indent=1) + "\n")
    print(f"written to {path} and {arguments.picture}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
