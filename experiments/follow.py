"""Does the schedule `auto` follow a world that stands still, drifts, and stands still again?

    python -m experiments.follow --seeds 12

A minute each. Once with real processes, recorded; what the recording says about every window is compared with
the summary. Then in virtual time, over seeds, beside fixed holds, no hold and `live`: means with 95 %
intervals (Student), differences paired by seed. `docs/schedules.md` has the results.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray

from experiments.follow_picture import draw
from experiments.follow_runs import (
    ARMS,
    PARTS,
    UNIT_S,
    WINDOW,
    Chosen,
    Course,
    Floats,
    Lived,
    carry_out,
    command,
    read_chosen,
    read_lived,
    read_summary,
)
from experiments.intervals import Interval, half_widths, interval
from launcher.machine import machine
from learner.schedule.plan import LEAST_GAIN, LEAST_TRUST

NAMES = ("still", "drifting", "still again")
SETTLED = 0.5  # of each part: what a part begins with is the end of what was before, and at first learning


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    seeds: int = 12  # from 0 upwards, in virtual time
    live: bool = True
    """The recorded run with real processes; otherwise in virtual time too."""
    part_s: float = 60.0  # of each of the three parts
    more: str = ""
    """Settings of every run that differ: --more="--learner.table.eta 0.5"."""
    out: Path = Path("benchmarks/results")
    picture: Path = Path("docs/follow.png")


def by_part(values: Floats) -> Floats:
    """Means of what comes at equal intervals over each part, and over the later half of each.

    [..., 3 n] -> [..., 3, 2]: the whole part, then its later half.
    """
    parts = values.reshape(*values.shape[:-1], PARTS, -1)
    late = parts[..., int(parts.shape[-1] * SETTLED) :]
    return np.stack([parts.mean(-1), late.mean(-1)], -1)


def reaction(hold: NDArray[np.int64], windows: int) -> tuple[int, int]:
    """How long N takes to follow, in windows: of the second part up to its first hold, that one included (one
    more than there are, if there is none), and of the third up to its last hold, 0 if there is none.

    Args:
        hold: N of each window, [3 windows].
        windows: of a part.
    """
    second, third = (np.flatnonzero(hold[part * windows : (part + 1) * windows]) for part in (1, 2))
    return int(second[0]) + 1 if len(second) else windows + 1, int(third[-1]) + 1 if len(third) else 0


def sum_up(lived: Mapping[str, Sequence[Lived]], course: Course) -> dict[str, Any]:
    """All numbers, for the file; intervals as [mean, half width]."""
    hold = np.array([one.hold for one in lived["auto"]])  # [seeds, windows]
    lost = {name: by_part(np.stack([one.regret for one in runs])) for name, runs in lived.items()}
    learned = {name: by_part(np.stack([one.learned for one in runs])) for name, runs in lived.items()}
    begun, ended = zip(*(reaction(one, course.windows) for one in hold), strict=True)
    return {
        "hold": _cells(by_part(hold.astype(float))),
        "share_of_windows_with_a_hold": _cells(by_part((hold > 0).astype(float))),
        "hold_by_window": {"mean": hold.mean(0).tolist(), "half": half_widths(hold.astype(float)).tolist()},
        "windows_to_the_first_hold": list(begun),
        "windows_to_the_last_hold": list(ended),
        "regret_per_unit": _regrets(lost),
        "regret_per_unit_without_random_actions": _regrets(learned),
    }


def _regrets(found: Mapping[str, Floats]) -> dict[str, Any]:
    """Of each arm, and of `auto` less each other one, paired; [seeds, 3, 2] each."""
    less = {f"auto - {name}": found["auto"] - other for name, other in found.items() if name != "auto"}
    return {name: _cells(one) for name, one in {**found, **less}.items()}


def _cells(found: Floats) -> dict[str, dict[str, list[float]]]:
    """[seeds, 3, 2] by name of the part, whole and settled."""
    return {
        name: {
            span: _plain(interval(found[:, part, column])) for column, span in enumerate(("whole", "settled"))
        }
        for part, name in enumerate(NAMES)
    }


def _plain(found: Interval) -> list[float]:
    return [round(found.mean, 6), round(found.half, 6)]


def record(arguments: Arguments, drift: Path, course: Course, directory: Path) -> dict[str, Any]:
    """The recorded run: its windows, and what the rest of its summary says of it."""
    run = directory / "recorded"
    verb = "run" if arguments.live else "sim"
    carry_out(command(verb, "auto", drift, course, 0, run, ["--record", *arguments.more.split()]))
    summary = read_summary(run)
    return {
        "clock": summary["clock"],
        "chosen": read_chosen(run, course),
        "ticks": summary["ticks"],
        "missed": summary["deadlines"]["missed"],
        "lost": summary["transitions"]["lost"],
        "regret_per_unit": summary["regret"]["per_unit"],
    }


def repeat(arguments: Arguments, drift: Path, course: Course, directory: Path) -> dict[str, list[Lived]]:
    """Every arm with every seed, in virtual time."""
    found: dict[str, list[Lived]] = {}
    for name in ARMS:
        found[name] = []
        for seed in range(arguments.seeds):
            run = directory / f"{name}-{seed}"
            carry_out(
                command("sim", name, drift, course, seed, run, ["--no-record", *arguments.more.split()])
            )
            found[name].append(read_lived(run, course))
    return found


def show(chosen: Sequence[Chosen], results: Mapping[str, Any]) -> None:
    """The recorded run's windows, and the tables over the seeds."""
    for one in chosen:
        print(f"{one.m:3} N = {one.hold:2}  {one.why}")
    print(f"{'':<46}" + "".join(f"{f'{name}, {span}':>24}" for name in NAMES for span in ("whole", "late")))
    rows = {
        "auto: N": results["hold"],
        "auto: share of windows with a hold": results["share_of_windows_with_a_hold"],
        **{f"regret, {name}": found for name, found in results["regret_per_unit"].items()},
        **{
            f"regret of the learned policy, {name}": found
            for name, found in results["regret_per_unit_without_random_actions"].items()
        },
    }
    for title, row in rows.items():
        cells = (row[name][span] for name in NAMES for span in ("whole", "settled"))
        print(f"{title:<46}" + "".join(f"{f'{mean:z.3f} ± {half:.3f}':>24}" for mean, half in cells))
    for name in ("first", "last"):
        print(f"windows to the {name} hold: {results[f'windows_to_the_{name}_hold']}")


def write(
    arguments: Arguments, course: Course, recorded: Mapping[str, Any], results: Mapping[str, Any]
) -> Path:
    """The dated file of results."""
    now = datetime.now(UTC)
    written = {
        "date": now.isoformat(timespec="seconds"),
        "machine": machine(),
        "numpy": version("numpy"),
        "command": ["tenuto", *command("run", "auto", Path("drift.csv"), course, 0, Path("RUN"), ())[3:]],
        "more": arguments.more,
        "window": WINDOW,
        "part_units": course.part,
        "seeds": list(range(arguments.seeds)),
        "least_trust": LEAST_TRUST,
        "least_gain": LEAST_GAIN,
        "recorded": {**recorded, "chosen": [_row(one) for one in recorded["chosen"]]},
        **results,
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{now:%Y-%m-%d}-follow.json"
    path.write_text(json.dumps(written, indent=1, allow_nan=False) + "\n")
    return path


def _row(one: Chosen) -> dict[str, Any]:
    found = asdict(one)
    unknown = {name: None for name, value in found.items() if isinstance(value, float) and math.isnan(value)}
    return found | unknown  # NaN is no JSON


def main(arguments: Arguments) -> None:
    """Run it all, print it, and write the results and the picture."""
    if arguments.seeds < 2:
        raise SystemExit(f"seeds = {arguments.seeds}: must be 2 or more")
    course = Course(round(arguments.part_s / UNIT_S))
    if course.part % WINDOW or course.windows < 2:
        raise SystemExit(f"part_s = {arguments.part_s}: must be two or more windows of {WINDOW * UNIT_S:g} s")
    with tempfile.TemporaryDirectory() as name:
        drift = Path(name) / "drift.csv"
        course.write(drift)
        recorded = record(arguments, drift, course, Path(name))
        results = sum_up(repeat(arguments, drift, course, Path(name)), course)
    show(recorded["chosen"], results)
    path = write(arguments, course, recorded, results)
    mean, half = (np.array(results["hold_by_window"][name]) for name in ("mean", "half"))
    draw(arguments.picture, course, recorded["chosen"], mean, half)
    print(f"written to {path} and {arguments.picture}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
