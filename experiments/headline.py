"""Does holding the policy pay? The paper's Algorithm 1 on tables, its exact dynamic regret, and its controls.

    python -m experiments.headline --seeds 24

Regret per step over the units 80 .. 799, of windows of 20 units of which G are updated in. Every arm of a
setting lives through the same worlds with the same chance, so differences are paired by phase; intervals are
Student's, 95 %, over phases. `docs/headline.md` has the results.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from experiments import headline_arms, headline_worlds
from experiments.headline_arms import WINDOW, Arm, live
from experiments.headline_picture import Curves, Ratio, draw
from experiments.headline_worlds import BURN, UNITS, Floats, Luck, Setting, make_worlds
from experiments.intervals import Interval, interval
from launcher.machine import machine
from learner.schedule.plan import LEAST_GAIN, LEAST_TRUST

UPDATES = (2, 5, 7, 10, 14, WINDOW)  # G
NO_HOLD = f"G={WINDOW}"
FIXED = {f"G={update}": Arm(update=update) for update in UPDATES}
HOLD_FIRST = {f"hold first, G={update}": Arm(update=update, first="hold") for update in UPDATES[:-1]}
MATCHED = {f"rate of G={update}": Arm(update=update, matched=True) for update in UPDATES[:-1]}
EXACT = {f"exact, G={update}": Arm(update=update, ahead="exact") for update in UPDATES}
OTHERS = {
    "live": Arm(refresh="unit", ahead="next"),
    "live, newest Q": Arm(refresh="unit", ahead="none"),
    "next unit": Arm(ahead="next"),
    "newest Q": Arm(ahead="none"),
    "no hold, shrunk": Arm(shrink=True),
    "plan": Arm(update="plan"),
    "plan, 10 %": Arm(update="plan", least_gain=0.1),
    "plan, shrunk": Arm(update="plan", shrink=True),
    "auto": Arm(update="plan", least_gain=LEAST_GAIN, least_trust=LEAST_TRUST, moving=True),
    "auto_bound": Arm(update="bound"),
}
ARMS = FIXED | HOLD_FIRST | MATCHED | EXACT | OTHERS
# What is paired beyond no hold: a hold and its rate, a forecast and none, a plan and what it competes with.
DIFFERENCES = (
    *((f"G={update}", f"rate of G={update}") for update in UPDATES[:-1]),
    ("live", "live, newest Q"),
    (NO_HOLD, "newest Q"),
    *((f"exact, G={update}", f"exact, {NO_HOLD}") for update in UPDATES[:-1]),
    ("plan", "G=7"),
    ("plan", "live"),
    ("auto", "G=7"),
    ("auto", "plan"),
    ("auto", "live"),
    ("auto_bound", "G=7"),
)
DRIFTING, STATIONARY = Setting(), Setting(period=None)
FAMILY = tuple(
    Setting(slip=slip, period=period, eta=eta)
    for slip, period, eta in product((0.0, 0.1), (None, 120.0, 160.0, 300.0), (0.05, 0.2, 0.5))
)
SLOWER = Setting(eta=0.1)  # between two rates of the family
RANDOM = tuple(
    Setting(world="random", period=period, eta=eta)
    for period, eta in product((160.0, None), (0.05, 0.2, 0.5))
)
RANDOM_MDPS = 16  # at most
RESAMPLES = 2000
LATE = 400  # units
# What the table of all settings shows.
COLUMNS = (*FIXED, "rate of G=5", "rate of G=7", "hold first, G=14", "exact, G=7", "exact, G=20", *OTHERS)


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    seeds: int = 24  # from 0 upwards: phases of the chain; the first 16 are the random MDPs
    out: Path = Path("benchmarks/results")
    picture: Path = Path("docs/headline.png")


class Found(NamedTuple):
    """Of one setting and n lanes, by arm."""

    regret: Mapping[str, Floats]  # [n], per step
    in_window: Mapping[str, Floats]  # [W, n], of the units of a window, mean over windows
    update: Mapping[str, float]  # mean G
    late: Mapping[str, Floats]  # [n], per step of the last `LATE` units, when no arm is still starting
    late_update: Mapping[str, float]  # mean G of these


class Share(NamedTuple):
    """Geometric mean of ratios over settings, with a 95 % interval by resampling the phases."""

    mean: float
    low: float
    high: float


def run(setting: Setting, seeds: range, arms: Mapping[str, Arm]) -> Found:
    """All arms in one setting."""
    worlds, luck = make_worlds(setting, seeds, UNITS + WINDOW), Luck.draw(seeds)
    regret, update = live(worlds, list(arms.values()), setting.eta, luck)
    counted = regret[:, BURN:]
    by_window = counted.reshape(len(arms), -1, WINDOW, len(seeds)).mean(1)
    return Found(
        dict(zip(arms, counted.mean(1), strict=True)),
        dict(zip(arms, by_window, strict=True)),
        dict(zip(arms, update[:, BURN:].mean((1, 2)).tolist(), strict=True)),
        dict(zip(arms, regret[:, -LATE:].mean(1), strict=True)),
        dict(zip(arms, update[:, -LATE:].mean((1, 2)).tolist(), strict=True)),
    )


def less(found: Found, arm: str, other: str = NO_HOLD) -> Interval:
    """By how much an arm's regret is above another's, paired by lane."""
    return interval(found.regret[arm] - found.regret[other])


def wins(found: Found, arm: str, other: str = NO_HOLD) -> int:
    """Lanes in which it is strictly below."""
    return int((found.regret[arm] < found.regret[other]).sum())


def of_best_fixed(results: Mapping[Setting, Found], arm: str) -> Share:
    """An arm's regret as a share of the best fixed G's in hindsight, which differs between settings.

    Both are means over lanes, and settings must have the same lanes.
    """
    ours = np.stack([found.regret[arm] for found in results.values()])
    fixed = np.stack([[found.regret[name] for name in FIXED] for found in results.values()])
    lanes = ours.shape[1]
    # how often each lane is drawn; the first row is the sample itself
    drawn = np.random.default_rng(0).multinomial(lanes, np.full(lanes, 1 / lanes), RESAMPLES)
    counts = np.vstack([np.ones(lanes), drawn])
    ratios = np.log((ours @ counts.T) / (fixed @ counts.T).min(1)).mean(0)
    return Share(math.exp(ratios[0]), *np.exp(np.quantile(ratios[1:], (0.025, 0.975))).tolist())


def over_no_hold(results: Mapping[Setting, Found], arm: str) -> float:
    """The largest ratio of mean regrets, of an arm and no hold, over settings."""
    return max(_ratio(found, arm) for found in results.values())


def show(title: str, found: Found) -> None:
    """A table: each arm's regret, and what it is above no hold."""
    print(f"{title}\n{'':20}{'regret per step':>20}{'less no hold':>22}{'below it':>10}{'mean G':>8}")
    lanes = len(found.regret[NO_HOLD])
    for arm, regret in found.regret.items():
        line = f"{_digits(interval(regret)):>20}{_digits(less(found, arm)):>22}"
        print(f"  {arm:<18}{line}{f'{wins(found, arm)}/{lanes}':>10}{found.update[arm]:8.1f}")
    for one, other in DIFFERENCES:
        print(f"  {one + ' - ' + other:<38}{_digits(less(found, one, other)):>22}")


def main(arguments: Arguments) -> None:
    """Run every setting, print the tables, write the results and the picture."""
    if arguments.seeds < 2:
        raise SystemExit(f"seeds = {arguments.seeds}: must be 2 or more")
    results: dict[Setting, Found] = {}
    for setting in (*FAMILY, SLOWER, *RANDOM):
        seeds = range(arguments.seeds if setting.world == "chain" else min(arguments.seeds, RANDOM_MDPS))
        results[setting] = run(setting, seeds, ARMS)
        show(str(setting), results[setting])
    family = {setting: results[setting] for setting in FAMILY}
    shares = {arm: of_best_fixed(family, arm) for arm in COLUMNS}
    print(f"regret / best fixed G's in hindsight, geometric mean over {len(FAMILY)} settings of the chain")
    for arm, share in shares.items():
        print(f"  {arm:<18}{share.mean:6.3f} [{share.low:.3f}, {share.high:.3f}]")
    random = {setting: results[setting] for setting in RANDOM}
    print("largest regret / no hold's over the random MDPs' settings")
    for arm in COLUMNS:
        print(f"  {arm:<18}{over_no_hold(random, arm):6.3f}")
    path = write(arguments, results, shares)
    picture(results, arguments.picture)
    print(f"written to {path} and {arguments.picture}")


def write(arguments: Arguments, results: Mapping[Setting, Found], shares: Mapping[str, Share]) -> Path:
    """The dated file of results."""
    now = datetime.now(UTC)
    arms, worlds = headline_arms, headline_worlds
    content = {
        "benchmark": "headline",
        "date": now.isoformat(timespec="seconds"),
        "machine": {**machine(), "versions": {"numpy": version("numpy")}},
        "units": UNITS,
        "burn": BURN,
        "late": LATE,
        "episode_steps": worlds.EPISODE_STEPS,
        "window": WINDOW,
        "gamma": worlds.GAMMA,
        "tau": arms.TAU,
        "step_size": arms.STEP_SIZE,
        "explore": arms.EXPLORE,
        "l_p": arms.L_P,
        "arms": {name: asdict(arm) for name, arm in ARMS.items()},
        "settings": [record(setting, found) for setting, found in results.items()],
        "of_best_fixed": {arm: [round(value, 4) for value in share] for arm, share in shares.items()},
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{now:%Y-%m-%d}-headline.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    return path


def record(setting: Setting, found: Found) -> dict[str, Any]:
    """One setting for the file; [mean, half width of the interval], and by lane for the headline's two."""
    row: dict[str, Any] = {"setting": asdict(setting), "lanes": len(found.regret[NO_HOLD]), "arms": {}}
    row["difference"] = {f"{one} - {other}": _plain(less(found, one, other)) for one, other in DIFFERENCES}
    for arm, regret in found.regret.items():
        row["arms"][arm] = {
            "regret": _plain(interval(regret)),
            "less_no_hold": _plain(less(found, arm)),
            "below_no_hold": wins(found, arm),
            "mean_update": round(found.update[arm], 2),
            "late": _plain(interval(found.late[arm])),
            "late_update": round(found.late_update[arm], 2),
        }
        if setting in {DRIFTING, STATIONARY}:
            row["arms"][arm]["by_lane"] = [round(float(value), 6) for value in regret]
    return row


def picture(results: Mapping[Setting, Found], path: Path) -> None:
    """Draw the headline, its stationary twin, where in a window regret arises, and all settings."""
    curves = {}
    for title, setting in (("period 160", DRIFTING), ("stationary", STATIONARY)):
        found = results[setting]
        rows = {
            "hold after (the paper)": FIXED,
            "hold first": HOLD_FIRST,
            "no hold, lower rate": MATCHED,
            "true future Q*": EXACT,
        }
        over = {name: [interval(found.regret[arm]) for arm in arms] for name, arms in rows.items()}
        flat = {arm: interval(found.regret[arm]) for arm in ("auto", "live")}
        curves[title] = Curves(UPDATES, over, flat)
    inside = {
        arm: results[DRIFTING].in_window[arm].mean(-1)
        for arm in (NO_HOLD, "G=7", "exact, G=20", "auto", "live")
    }
    table = {
        str(setting): {arm: Ratio(_ratio(found, arm), less(found, arm).apart) for arm in COLUMNS}
        for setting, found in results.items()
    }
    draw(curves, inside, table, path)


def _ratio(found: Found, arm: str) -> float:
    return float(found.regret[arm].mean() / found.regret[NO_HOLD].mean())


def _plain(found: Interval) -> list[float]:
    return [round(found.mean, 5) + 0.0, round(found.half, 5)]


def _digits(found: Interval) -> str:
    return f"{found.mean:z.4f} ± {found.half:.4f}"


if __name__ == "__main__":
    main(tyro.cli(Arguments))
