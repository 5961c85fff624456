"""What the rules for the schedule `auto` are judged by, and on what."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments import headline_rules
from experiments.headline import DRIFTING, FIXED, NO_HOLD, STATIONARY, Found
from experiments.headline_arms import WINDOW, Arm
from experiments.headline_rules import FIRST, Arguments, judged, rules
from experiments.headline_worlds import Setting
from learner.schedule.plan import LEAST_GAIN, LEAST_TRUST

RANDOM_STATIONARY = Setting(world="random", period=None)


def test_judged_by_hand() -> None:
    """The best fixed has 2. In the chain 1 and 8: sqrt(1/2 x 4). In the MDPs 6, and no hold has 3: 2. G is
    20 - 2 and 20 - 5 where nothing drifts; where something does, it does not count."""

    def found(regret: float, no_hold: float, update: float) -> Found:
        fixed = {name: np.full(3, no_hold if name == NO_HOLD else 2.0) for name in FIXED}
        return Found({**fixed, "a": np.full(3, regret)}, {}, {"a": update}, {}, {})

    results = {
        DRIFTING: found(1.0, 4.0, 3.0),
        STATIONARY: found(8.0, 4.0, 18.0),
        RANDOM_STATIONARY: found(6.0, 3.0, 15.0),
    }
    chain, random, hold, longest = judged(results, "a")
    assert chain.mean == pytest.approx(2**0.5)
    assert (random, hold, longest) == (2.0, 3.5, 5.0)


def test_the_rule_that_was_picked_is_among_them() -> None:
    assert Arm(update="plan", least_gain=LEAST_GAIN, least_trust=LEAST_TRUST, moving=True) in rules().values()
    assert Arm(update="plan", moving=True) in rules().values()


def test_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On seeds that no other result is of."""
    used: set[int] = set()

    def short(setting: Setting, seeds: range, arms: dict[str, Arm]) -> Found:
        used.update(seeds)
        regret = {name: np.full(len(seeds), 1.0 + i) for i, name in enumerate(arms)}
        return Found(regret, {}, dict.fromkeys(arms, WINDOW - 1.0), {}, {})

    monkeypatch.setattr(headline_rules, "run", short)
    headline_rules.main(Arguments(2, tmp_path))
    assert used == {FIRST, FIRST + 1} and min(used) >= 24
    [path] = tmp_path.glob("*-headline_rules.json")
    content = json.loads(path.read_text())
    assert content["rules"].keys() == rules().keys()
    assert {one["stationary_hold"] for one in content["rules"].values()} == {1.0}
