"""Does a forecast of Q help when the goal of the cliffworld switches? All readings of that experiment.

    python -m experiments.cliffworld --seeds 20

20 000 steps, and the goal switches at step 10 000. Reward per step, averaged over the paper's six (alpha,
epsilon) pairs for each seed; intervals are Student's over seeds. `docs/cliffworld.md` has the results.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from experiments.cliffworld_picture import Cell, Panel, draw
from experiments.intervals import Interval, half_widths, interval
from experiments.lanes import EPISODE_STEPS, PAIRS, Arm, Floats, Luck, Reading, play
from launcher.machine import machine
from rtcore.config import CliffConfig

STEPS, SWITCH, BIN = 20_000, 10_000, 500
LATER = 20_000  # steps before those, for every arm to have learned the first goal when it moves
# Steps whose mean reward is compared: before the switch, then up to and around the 15 000th, after which the
# paper's future Q has adapted, and the last.
SPANS = ((9_000, 10_000), (14_000, 15_000), (15_500, 16_500), (19_000, 20_000))
ARMS = {
    "Q": Arm(),
    "FQ": Arm(acts="forecast", l_p=5),
    "frozen Q": Arm(acts="forecast"),
    "Q, 2 alpha": Arm(step_factor=2.0),
    "write-back": Arm(l_p=2, l_f=3.0, write_back=0.3),
}
DIFFERENCES = (("FQ", "Q"), ("FQ", "frozen Q"), ("Q, 2 alpha", "Q"), ("write-back", "Q, 2 alpha"))
DEFAULT = Reading(CliffConfig(), 1.0)
PLAIN = Reading(CliffConfig(pays="arrive", inactive_goal="ordinary"), 0.9)
SWAPPED, LATE = "goals swapped", f"switch {LATER} steps later"  # of the default reading

Curves = Mapping[str, Floats]  # by arm: [seeds, bins], mean reward per step over the six pairs


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    seeds: int = 20  # from 0 upwards
    out: Path = Path("benchmarks/results")
    picture: Path = Path("docs/cliffworld.png")


def readings() -> Iterator[Reading]:
    """All 24: pays x inactive goal x gamma x step reward."""
    pays: tuple[Literal["leave", "arrive"], ...] = ("leave", "arrive")
    inactive: tuple[Literal["terminal", "ordinary"], ...] = ("terminal", "ordinary")
    for step_reward, when, other, gamma in itertools.product(
        (-1.0, -100.0), pays, inactive, (1.0, 0.99, 0.9)
    ):
        yield Reading(CliffConfig(pays=when, inactive_goal=other, step_reward=step_reward), gamma)


def curve(reading: Reading, arm: Arm, luck: Luck, *, switch: int = SWITCH, first: int = 0) -> Floats:
    """Mean reward per step of each seed, [seeds, bins], over the six pairs and the steps of a bin."""
    steps, lanes = luck.action.shape
    assert steps % BIN == 0, "the steps must be whole bins"
    sums = np.zeros((steps // BIN, lanes))
    for step, moment in enumerate(play(reading, arm, luck, switch=switch, first=first)):
        sums[step // BIN] += moment.reward
    means: Floats = sums.reshape(-1, lanes // len(PAIRS), len(PAIRS)).mean(2).T / BIN
    return means


def over(curve_of_arm: Floats, span: tuple[int, int]) -> Floats:
    """Mean reward per step of each seed over the steps of `span`, [seeds]."""
    means: Floats = curve_of_arm[:, span[0] // BIN : span[1] // BIN].mean(1)
    return means


def spans(curves: Curves) -> dict[str, list[Interval]]:
    """Each arm's reward over each of `SPANS`."""
    return {name: [interval(over(found, span)) for span in SPANS] for name, found in curves.items()}


def differences(curves: Curves) -> dict[str, list[Interval]]:
    """The differences that `DIFFERENCES` names over each of `SPANS`, paired by seed."""
    return {
        f"{a} - {b}": [interval(over(curves[a], span) - over(curves[b], span)) for span in SPANS]
        for a, b in DIFFERENCES
    }


def record(reading: Reading, curves: Curves, *, whole: bool) -> dict[str, Any]:
    """A reading's results for the file, with its curves if `whole`; [mean, half width of the interval]."""
    found: dict[str, Any] = {
        "reading": asdict(reading),
        "reward": _plain(spans(curves)),
        "difference": _plain(differences(curves)),
    }
    if whole:
        found["curve"] = {
            name: {"mean": _rounded(one.mean(0)), "half": _rounded(half_widths(one))}
            for name, one in curves.items()
        }
    return found


def show(title: str, rows: Mapping[str, list[Interval]]) -> None:
    """A block of the table: a row each, a column per span."""
    print(f"{title:<28}" + "".join(f"{f'{low}-{high}':>18}" for low, high in SPANS))
    for name, intervals in rows.items():
        print(f"  {name:<26}" + "".join(f"{found!s:>18}" for found in intervals))


def main(arguments: Arguments) -> None:
    """Run every reading and arm, print the tables, write the results and the picture."""
    if arguments.seeds < 2:
        raise SystemExit(f"seeds = {arguments.seeds}: must be 2 or more")
    luck = Luck.draw(range(arguments.seeds), STEPS)
    found: dict[Reading, Curves] = {}
    for reading in readings():
        found[reading] = {name: curve(reading, arm, luck) for name, arm in ARMS.items()}
        show(str(reading), spans(found[reading]) | differences(found[reading]))
    more = {
        SWAPPED: {name: curve(DEFAULT, arm, luck, first=1) for name, arm in ARMS.items()},
        LATE: late(Luck.draw(range(arguments.seeds), LATER + STEPS)),
    }
    for title, curves in more.items():
        show(title, spans(curves) | differences(curves))
    path = write(arguments, found, more)
    picture(found, more[LATE], arguments.picture)
    print(f"written to {path} and {arguments.picture}")


def late(luck: Luck) -> Curves:
    """The default reading with `LATER` steps more before the switch: the last `STEPS` of them all."""
    return {
        name: curve(DEFAULT, arm, luck, switch=LATER + SWITCH)[:, -STEPS // BIN :]
        for name, arm in ARMS.items()
    }


def write(arguments: Arguments, found: Mapping[Reading, Curves], more: Mapping[str, Curves]) -> Path:
    """The dated file of results; `more` are variations of the default reading."""
    now = datetime.now(UTC)
    results = {
        "benchmark": "cliffworld",
        "date": now.isoformat(timespec="seconds"),
        "machine": {**machine(), "versions": {"numpy": version("numpy")}},
        "seeds": list(range(arguments.seeds)),
        "steps": STEPS,
        "switch": SWITCH,
        "episode_steps": EPISODE_STEPS,
        "bin_steps": BIN,
        "pairs": PAIRS,
        "spans": SPANS,
        "arms": {name: asdict(arm) for name, arm in ARMS.items()},
        "readings": [
            record(reading, curves, whole=reading in (DEFAULT, PLAIN)) for reading, curves in found.items()
        ],
        "default_reading": {title: record(DEFAULT, curves, whole=True) for title, curves in more.items()},
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{now:%Y-%m-%d}-cliffworld.json"
    path.write_text(json.dumps(results, indent=1) + "\n")
    return path


def picture(found: Mapping[Reading, Curves], later: Curves, path: Path) -> None:
    """Draw three cases as curves, and the matrix of all readings before and after the switch."""
    panels = [
        _panel(f"{DEFAULT}", found[DEFAULT], 0),
        _panel(f"{DEFAULT}: learned for longer", later, LATER),
        _panel(f"{PLAIN}", found[PLAIN], 0),
    ]
    matrix = {
        f"steps {span[0]} to {span[1]}": {
            f"{reading}": {
                name: Cell(interval(over(one, span)), interval(over(one, span) - over(curves["Q"], span)))
                for name, one in curves.items()
            }
            for reading, curves in found.items()
        }
        for span in (SPANS[0], *SPANS[2:])
    }
    draw(panels, matrix, path)


def _panel(title: str, curves: Curves, start: int) -> Panel:
    steps: Floats = np.arange(start + BIN / 2, start + STEPS, BIN, dtype=np.float64)
    arms = {name: (one.mean(0), half_widths(one)) for name, one in curves.items()}
    return Panel(title, steps, arms, start + SWITCH)


def _plain(rows: Mapping[str, list[Interval]]) -> dict[str, list[list[float]]]:
    return {name: [_rounded([found.mean, found.half]) for found in row] for name, row in rows.items()}


def _rounded(values: Floats | list[float]) -> list[float]:
    return [round(float(value), 3) + 0.0 for value in values]  # + 0.0: no -0.0


if __name__ == "__main__":
    main(tyro.cli(Arguments))
