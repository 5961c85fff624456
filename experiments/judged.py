"""Does a forecast that is judged earn trust where it can, and lose it where it cannot?

    python -m experiments.judged

Runs `fq` in virtual time on a small MDP whose rewards, and with gamma = 0 so its Q, drift along a line, and
on the same MDP with rewards that jump about every unit. At each t_m the forecast made a window before is
compared with the table reached, beside the table of then; the share that the policy takes of the forecast
follows. Prints both runs window by window, as they are read back from the recordings' `/learner/forecast`.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import tyro

from env_server.worlds.registry import resolve
from experiments.finite_presets import random_mdp
from launcher.sim import simulate
from launcher.summary import summarise
from recorder.reading import columns, series
from rtcore.config import DriftConfig, ForecastConfig, RunConfig, ScheduleConfig, TableConfig
from rtcore.lifecycle import Stop
from rtcore.run_dir import RunDir

WINDOW, TICKS = 10, 200  # of a window in units, of a unit in ticks
DRIFTS = {
    "line": DriftConfig(kind="ramp", amplitude=1.0),  # over the whole run
    "noise": DriftConfig(kind="noise", offset=0.5, sd=0.2, low=0.0, high=1.0),
}


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    seeds: int = 3
    units: int = 200
    out: Path | None = None
    """A file for the numbers, as JSON; without it they are only printed."""


@dataclass(frozen=True)
class Judged:
    """One window's end.

    Attributes:
        window: how many forecasts have been judged by then.
        error: of the forecast, root mean square over (s, a).
        baseline_error: of the table at the window's start.
        trust: share of the next forecast in what the policy follows.
    """

    window: int
    error: float
    baseline_error: float
    trust: float


def configure(drift: str, seed: int, units: int) -> RunConfig:
    """The run: half of the actions random, a table that follows its rewards within a unit or so."""
    base = random_mdp()
    learner = replace(
        base.learner,
        algo="fq",
        gamma=0.0,
        schedule=ScheduleConfig(l_f=WINDOW, gamma_f=1.0),
        forecast=ForecastConfig(l_p=5, trust="judged"),
        table=TableConfig(step_size=0.3, epsilon=0.5),
    )
    env = replace(
        base.env,
        hz=float(TICKS),
        unit_s=1.0,
        drift=replace(DRIFTS[drift], span=float(units)),
        mdp=replace(base.env.mdp, concentration=3.0),  # every state is visited often
    )
    recorder = replace(base.recorder, detail="light")
    config = replace(base, seed=seed, duration_s=float(units), learner=learner, recorder=recorder)
    return replace(config, env=resolve(env))


def run(drift: str, seed: int, units: int, directory: Path) -> list[Judged]:
    """Run it, and read each window's judgement from the recording.

    Raises:
        AssertionError: the recording and the summary do not say the same.
    """
    config = configure(drift, seed, units)
    run_dir = RunDir.create(directory / f"{drift}-{seed}", config)
    stats, wall_s = simulate(config, run_dir, Stop(), lambda _: None)
    found = read(run_dir.recording_path)
    forecast = summarise(config, "judged", stats, wall_s=wall_s, restarts={}, clock="virtual")["forecast"]
    assert len(found) == forecast["windows"], "one row per window"
    mean = sum(one.error for one in found) / len(found)
    assert abs(mean - forecast["error"]) < 1e-9, "the mean error of the rows is that of the summary"
    return found


def read(recording: Path) -> list[Judged]:
    """The first row after each window's end."""
    names = series(recording, "/learner/forecast")
    _, values = columns(recording, "/learner/forecast", timeline="run_time")
    found: dict[int, Judged] = {}
    for row in values:
        at = dict(zip(names, row.tolist(), strict=True))
        window = int(at["windows"])
        if window and window not in found:
            found[window] = Judged(window, at["last_error"], at["last_baseline_error"], at["trust"])
    return list(found.values())


def show(drift: str, runs: Sequence[Sequence[Judged]]) -> None:
    """A line per window, means over the seeds."""
    print(f"{drift}: means over {len(runs)} seeds")
    print(f"{'window':>6} {'error':>8} {'baseline':>8} {'trust':>6}")
    for windows in zip(*runs, strict=True):
        error, baseline, trust = (
            sum(getattr(one, name) for one in windows) / len(windows)
            for name in ("error", "baseline_error", "trust")
        )
        print(f"{windows[0].window:6} {error:8.4f} {baseline:8.4f} {trust:6.2f}")


def main(arguments: Arguments) -> None:
    """Run both worlds, print them, and write the numbers down."""
    results: dict[str, list[list[Judged]]] = {}
    with tempfile.TemporaryDirectory() as directory:
        for drift in DRIFTS:
            results[drift] = [
                run(drift, seed, arguments.units, Path(directory)) for seed in range(arguments.seeds)
            ]
            show(drift, results[drift])
    if arguments.out is not None:
        written = {
            drift: [[asdict(one) for one in windows] for windows in runs] for drift, runs in results.items()
        }
        arguments.out.write_text(json.dumps(written, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
