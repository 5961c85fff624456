"""What does a learner that takes every core cost the tick, and what does the governor save?

    python -m benchmarks.governor --rounds 3 --seconds 30

The whole system as real processes without real-time placement (`agent.rt = "off"`), at 500 Hz, with a
learner of as many threads as cores that never runs out of work: governor on and off by turns, and beside
them a learner that hardly works, because what is missed then no governor can save. What a learner costs
is what is missed beyond that. The first seconds stand apart: everything starts in them.
"""

from __future__ import annotations

import json
import os
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.machine import facts
from launcher import presets
from launcher.latency.trial import Load, Trial, trial_config
from launcher.latency.trial_run import run_trial

Setting = Literal["off", "on", "no load"]
SETTINGS: tuple[Setting, ...] = ("off", "on", "no load")


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    preset: str = "pointmass"
    hz: float = 500.0
    seconds: float = 30.0
    rounds: int = 3
    warm_up_s: float = 5.0  # counted apart
    threads: int = field(default_factory=lambda: os.cpu_count() or 1)
    hidden: tuple[int, ...] = (256, 256)
    batch: int = 256
    out: Path = Path("benchmarks/results")


@dataclass(frozen=True)
class Row:
    """One run.

    Attributes:
        missed: ticks without an answer in time, and deadlines that the env server overslept.
        each_second: the same for each second of the run.
        missed_late, ticks_late: after the warm-up.
        causes: of the misses; `skipped` are the overslept deadlines.
    """

    round: int
    governor: Setting
    ticks: int
    missed: int
    ticks_late: int
    missed_late: int
    causes: dict[str, int]
    skipped: int
    loop_p99_us: float | None
    updates_per_s: float | None
    steal_s: float | None
    each_second: list[int]


def measure(arguments: Arguments, governor: Setting, number: int) -> Row:
    """One run."""
    base = presets.load(arguments.preset)
    load: Load = "none" if governor == "no load" else "learner"
    config = trial_config(base, hz=arguments.hz, load=load, seconds=arguments.seconds, rt="off")
    learner = replace(
        config.learner,
        governor="off" if governor == "off" else "on",
        threads=arguments.threads,
        hidden=arguments.hidden,
        batch=arguments.batch,
    )
    return judge(run_trial(replace(config, learner=learner), load), arguments, governor, number)


def judge(trial: Trial, arguments: Arguments, governor: Setting, number: int) -> Row:
    """A run's misses, second by second."""
    each_second = lost_each_second(trial, arguments.seconds)
    warm = round(arguments.warm_up_s)
    return Row(
        round=number,
        governor=governor,
        ticks=trial.ticks + trial.skipped,
        missed=trial.missed + trial.skipped,
        ticks_late=round((arguments.seconds - warm) * arguments.hz),
        missed_late=sum(each_second[warm:]),
        causes=trial.causes,
        skipped=trial.skipped,
        loop_p99_us=trial.quantiles_us("loop")["p99"],
        updates_per_s=trial.updates_per_s,
        steal_s=trial.steal_s,
        each_second=each_second,
    )


def lost_each_second(trial: Trial, seconds: float) -> list[int]:
    """Misses and overslept deadlines in each second of run time."""
    last = max(1, round(seconds)) - 1
    lost = np.zeros(last + 1, np.int64)
    overslept = np.diff(trial.tick, prepend=-1) - 1  # before this tick
    at = np.minimum(trial.tick / trial.hz, last).astype(np.int64)
    np.add.at(lost, at, trial.was_missed + overslept)
    return [int(count) for count in lost]


def compare(rows: Sequence[Row]) -> dict[str, Any]:
    """Misses per tick over all rounds, with and without the warm-up, and the quotients, on over off."""
    found: dict[str, Any] = {}
    for name, missed, ticks in (("whole", "missed", "ticks"), ("after_warm_up", "missed_late", "ticks_late")):
        ratio = {}
        for setting in SETTINGS:
            mine = [row for row in rows if row.governor == setting]
            ratio[setting] = sum(getattr(r, missed) for r in mine) / sum(getattr(r, ticks) for r in mine)
        off, on = ratio["off"] - ratio["no load"], ratio["on"] - ratio["no load"]
        found[name] = {
            "miss_ratio": ratio,
            "on_over_off": ratio["on"] / ratio["off"] if ratio["off"] else None,
            "cost_on_over_off": on / off if off > 0 else None,
        }
    rates = {
        setting: [r.updates_per_s for r in rows if r.governor == setting and r.updates_per_s is not None]
        for setting in SETTINGS
    }
    return found | {"updates_per_s": {name: statistics.median(mine) for name, mine in rates.items() if mine}}


def told(name: str, part: dict[str, Any]) -> str:
    """One comparison on the screen."""
    quotients = (part["on_over_off"], part["cost_on_over_off"])
    both, cost = ("-" if quotient is None else f"{quotient:.3f}" for quotient in quotients)
    missed = ", ".join(f"{setting} {share:.2%}" for setting, share in part["miss_ratio"].items())
    return f"{name.replace('_', ' ')}: missed {missed}; on / off {both}, of the learner's cost {cost}"


def line(row: Row) -> str:
    """One run on the screen."""
    causes = ", ".join(f"{count} {cause}" for cause, count in row.causes.items())
    return (
        f"round {row.round}, {row.governor:7}: {row.missed:5} of {row.ticks} missed"
        f" ({row.missed / row.ticks:.2%}), {row.missed_late} after the warm-up; {causes or 'no cause'},"
        f" {row.skipped} overslept; {row.updates_per_s or 0.0:.0f} updates/s, steal {row.steal_s or 0:.2f} s"
    )


def main(arguments: Arguments) -> None:
    """Run, print, write the result."""
    rows = []
    for number in range(arguments.rounds):
        for setting in SETTINGS if number % 2 == 0 else SETTINGS[::-1]:
            rows.append(measure(arguments, setting, number))
            print(line(rows[-1]), flush=True)
    found = compare(rows)
    print("\n".join(told(name, found[name]) for name in ("whole", "after_warm_up")))
    now = datetime.now(UTC)
    result = {
        "benchmark": "governor",
        "date": now.isoformat(timespec="seconds"),
        "machine": facts(("torch", "eclipse-zenoh")),
        "arguments": asdict(arguments) | {"out": str(arguments.out)},
        "comparison": found,
        "rows": [asdict(row) for row in rows],
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{now:%Y-%m-%d}-governor.json"
    path.write_text(json.dumps(result, indent=1) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
