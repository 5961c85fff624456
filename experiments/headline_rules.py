"""When is a planned hold worth it? Rules for the schedule `auto`, on phases that no other result is of.

    python -m experiments.headline_rules

A rule holds where the plan saves a least share of the predicted regret, and where more than a least share of
the slopes is no noise. It is judged in the headline's settings, but on phases of its own: 24 .. 47 of the
chain, and 16 random MDPs from 24 on. `learner.schedule.plan` has the pair that was picked, and why.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import NamedTuple

import tyro

from experiments.headline import (
    FAMILY,
    FIXED,
    RANDOM,
    RANDOM_MDPS,
    Found,
    Share,
    of_best_fixed,
    over_no_hold,
    run,
)
from experiments.headline_arms import WINDOW, Arm
from experiments.headline_worlds import Setting

FIRST = 24  # seeds from here on; the headline's are below
TRUSTS = (None, 0.1, 0.25, 0.5, 0.75, 0.9)
GAINS = (0.0, 0.05, 0.1, 0.2)


class Judged(NamedTuple):
    """A rule in all settings.

    Attributes:
        chain: regret over that of the best fixed G in hindsight, geometric mean.
        random: the largest ratio of regret to no hold's in the random MDPs' settings.
        hold: mean N where nothing drifts, of the unit 80 and later.
        longest: the same where it is the largest.
    """

    chain: Share
    random: float
    hold: float
    longest: float


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    seeds: int = 24
    out: Path = Path("benchmarks/results")


def judged(results: Mapping[Setting, Found], arm: str) -> Judged:
    """Of the results in `FAMILY` and `RANDOM`, or some of these."""
    chain = {setting: found for setting, found in results.items() if setting.world == "chain"}
    random = {setting: found for setting, found in results.items() if setting.world == "random"}
    hold = [WINDOW - found.update[arm] for setting, found in results.items() if setting.period is None]
    return Judged(of_best_fixed(chain, arm), over_no_hold(random, arm), sum(hold) / len(hold), max(hold))


def rules() -> dict[str, Arm]:
    """By what they ask for."""
    return {
        f"trust {least_trust}, gain {least_gain:g}": Arm(
            update="plan", least_gain=least_gain, least_trust=least_trust, moving=True
        )
        for least_trust, least_gain in product(TRUSTS, GAINS)
    }


def compared(seeds: int, settings: Iterable[Setting]) -> dict[str, Judged]:
    """All rules on that many phases, or fewer random MDPs."""
    arms, results = rules(), {}
    for setting in settings:
        number = seeds if setting.world == "chain" else min(seeds, RANDOM_MDPS)
        results[setting] = run(setting, range(FIRST, FIRST + number), FIXED | arms)
    return {name: judged(results, name) for name in arms}


def main(arguments: Arguments) -> None:
    """Compare the rules, print the table and write it."""
    if arguments.seeds < 2:
        raise SystemExit(f"seeds = {arguments.seeds}: must be 2 or more")
    found = compared(arguments.seeds, (*FAMILY, *RANDOM))
    print(f"{'':24}{'over the best fixed G':>24}{'worst random':>14}{'N, stationary':>15}{'at most':>9}")
    for name, one in found.items():
        share = f"{one.chain.mean:.3f} [{one.chain.low:.3f}, {one.chain.high:.3f}]"
        print(f"{name:<24}{share:>24}{one.random:14.3f}{one.hold:15.2f}{one.longest:9.2f}")
    now = datetime.now(UTC)
    content = {
        "benchmark": "headline_rules",
        "date": now.isoformat(timespec="seconds"),
        "first_seed": FIRST,
        "seeds": arguments.seeds,
        "arms": {name: asdict(arm) for name, arm in rules().items()},
        "rules": {
            name: {
                "of_best_fixed": [round(value, 4) for value in one.chain],
                "worst_random": round(one.random, 4),
                "stationary_hold": round(one.hold, 3),
                "longest_stationary_hold": round(one.longest, 3),
            }
            for name, one in found.items()
        },
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{now:%Y-%m-%d}-headline_rules.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
