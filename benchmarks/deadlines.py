"""Are the deadlines kept while a learner takes every core that it may have?

    python -m benchmarks.deadlines --seconds 60 --rounds 3

By turns, at each setting: the real system with a learner that never stops (100 gradient steps a transition
are more than any core makes), and the bare pacer-and-echo pair over raw Zenoh, alone on the machine: what
the host's own stalls cost. Miss ratios count the deadlines that an overrun lost. `unprivileged` has no more
of the scheduler than an ordinary user: no SCHED_FIFO, no locked memory, no raised priority.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks.harness import child_result, run_system, unprivileged, world, write_result
from benchmarks.outcome import Outcome, cell, median, turns
from rtcore import channels
from rtcore.config import ConfigError

SYSTEM, BARE = "tenuto", "bare pair"
SATURATING = 100.0  # gradient steps a transition
PACKAGES = ("eclipse-zenoh", "torch", "numpy")
OF_BARE = 1.2  # a limit that is broken is kept all the same within so much of the bare pair's
PACING_LIMIT_US = 150.0  # p99.9, with SCHED_FIFO


@dataclass(frozen=True)
class Setting:
    """A rate, with or without privileges, and the miss ratio that is allowed."""

    hz: float
    privileged: bool
    limit: float

    @property
    def name(self) -> str:
        """As the tables call it."""
        return f"{self.hz:g} Hz, {'privileged' if self.privileged else 'unprivileged'}"


SETTINGS = {
    "100": Setting(100.0, privileged=True, limit=0.0),
    "500": Setting(500.0, privileged=True, limit=1e-4),
    "1000": Setting(1000.0, privileged=True, limit=1e-3),
    "500-unprivileged": Setting(500.0, privileged=False, limit=1e-3),
}


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    settings: tuple[str, ...] = tuple(SETTINGS)
    world: str = "pointmass"
    governor: Literal["on", "off"] = "on"
    seconds: float = 60.0  # of each run
    rounds: int = 3
    out: Path = Path("benchmarks/results")


def measure(contender: str, setting: Setting, arguments: Arguments) -> Outcome:
    """One run of one contender."""
    prefix = () if setting.privileged else unprivileged()
    if contender == SYSTEM:
        config = world(arguments.world, hz=setting.hz, seconds=arguments.seconds, rt="auto")
        learner = replace(config.learner, utd=SATURATING, learning_starts=50, governor=arguments.governor)
        return run_system(replace(config, learner=learner), prefix=prefix)
    options = ["--transport=zenoh", f"--hz={setting.hz}", f"--seconds={arguments.seconds}"]
    return Outcome.read(
        child_result("benchmarks.echo_once", options, seconds=arguments.seconds, prefix=prefix)
    )


def judge(setting: Setting, ours: Sequence[Outcome], bare: Sequence[Outcome]) -> dict[str, Any]:
    """The medians, and whether they keep to the limits or to 1.2 times the bare pair's."""
    miss, bare_miss = (_median([one.miss_ratio for one in runs]) for runs in (ours, bare))
    pacing, bare_pacing = (_median([one.pacing_us["p999"] for one in runs]) for runs in (ours, bare))
    placements = [one.more["placement"][channels.ENV_SERVER] for one in ours]
    return {
        "setting": setting.name,
        "as_set": all(("SCHED_FIFO 50" in one) is setting.privileged for one in placements),
        "miss_ratio": miss,
        "bare_miss_ratio": bare_miss,
        "miss_limit": setting.limit,
        "misses_kept": miss
        <= (max(setting.limit, OF_BARE * bare_miss) if setting.privileged else setting.limit),
        "pacing_p999_us": pacing,
        "bare_pacing_p999_us": bare_pacing,
        "pacing_kept": not setting.privileged or pacing <= max(PACING_LIMIT_US, OF_BARE * bare_pacing),
        "updates_per_s": median([one.more["updates_per_s"] for one in ours]),
        "stolen_s": [one.stolen_s for one in ours],
        "bare_stolen_s": [one.stolen_s for one in bare],
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line per setting."""
    lines = [
        f"{'':26}{'miss ratio':>11}{'limit':>9}{'bare pair':>11}{'':6}{'pacing p99.9':>13}{'bare pair':>10}"
        f"{' us':9}{'updates/s':>10}{'stolen s: ours, bare':>22}"
    ]
    for row in rows:
        stolen = f"{_total(row['stolen_s']):.2f}, {_total(row['bare_stolen_s']):.2f}"
        misses = f"{row['miss_ratio']:11.6f}{row['miss_limit']:9.4f}{row['bare_miss_ratio']:11.6f}"
        pacing = f"{cell(row['pacing_p999_us'], 13)}{cell(row['bare_pacing_p999_us'], 10)}   "
        name = row["setting"] + ("" if row["as_set"] else " (!)")
        lines.append(
            f"{name:26}{misses}{_word(row['misses_kept']):>6}{pacing}{_word(row['pacing_kept']):>6}"
            f"{cell(row['updates_per_s'], 10)}{stolen:>22}"
        )
    return "\n".join(lines)


def _median(values: Sequence[float | None]) -> float:
    found = median(values)
    return float("nan") if found is None else found


def _total(values: Sequence[float | None]) -> float:
    return sum(value or 0.0 for value in values)


def _word(kept: bool) -> str:
    return "ok" if kept else "NO"


def main(arguments: Arguments) -> None:
    """Measure, print the table, write the result."""
    for name in arguments.settings:
        if name not in SETTINGS:
            raise ConfigError("settings", name, f"must be of {', '.join(SETTINGS)}")
    rows, runs = [], {}
    for name in arguments.settings:
        setting = SETTINGS[name]
        found: dict[str, list[Outcome]] = {SYSTEM: [], BARE: []}
        for _, contender in turns((SYSTEM, BARE), arguments.rounds):
            found[contender].append(measure(contender, setting, arguments))
        rows.append(judge(setting, found[SYSTEM], found[BARE]))
        runs[setting.name] = {key: [one.as_dict() for one in values] for key, values in found.items()}
        print(f"{setting.name}: done", flush=True)
        write_result("deadlines", arguments, PACKAGES, {"rows": rows, "runs": runs})
    print("\n" + table(rows))
    if not all(row["as_set"] for row in rows):
        print("(!) the system did not grant what the setting says: see `placement` in the file")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
