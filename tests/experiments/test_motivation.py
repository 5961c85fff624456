"""The motivating example through the world and the scripted learner."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.finite_presets import bandit_conservative, bandit_pessimistic
from experiments.motivation import (
    CONSERVATIVE,
    PESSIMISTIC,
    REWARDS,
    UNITS,
    Run,
    acted,
    check,
    configure,
    exact,
    policies,
    run,
)
from experiments.motivation_picture import draw
from experiments.ramps import Ramp, rewards_given
from rtcore.config_check import check as check_config


def test_the_policies_are_the_presets() -> None:
    for preset, ramp in ((bandit_conservative(), CONSERVATIVE), (bandit_pessimistic(), PESSIMISTIC)):
        table = preset.learner.table
        assert (table.tempo_begin, table.tempo_span) == (ramp.begin, ramp.span)
        assert preset.env.drift.span == UNITS


def test_exact_by_hand() -> None:
    """A jump at 60 of 120: swapped first in unit k, |k - 60| units lose all; beta is 0 in unit 60 itself.

    beta = 1 from unit 61 on, so the loss is |k - 61| / 120: at most 60 / 120.
    """
    found = exact(Ramp(60, 1))
    losses = np.abs(np.arange(1, 121) - 61) / 120
    assert found.mean == pytest.approx(1 - losses.mean())
    assert found.sd == pytest.approx(losses.std())
    assert found.least == pytest.approx(0.5)


def test_what_runs_earn_beyond_their_switches_by_hand() -> None:
    """beta = 0.5 throughout the first unit, then 0 until 60 and 1 from 61 on. Swapped at 61: 1 in every unit
    but the first, whose 49 draws have variance 1/4 each, so an average of 5880 has 49 / 4 / 5880^2."""
    ramp = Ramp(60, 1)
    expected = (0.5 + 119) / 120
    assert acted(ramp)[:2].tolist() == [0.5, 0.0]
    found = check(ramp, [Run(61, expected + 0.01), Run(61, expected + 0.03)])
    assert found.excess == pytest.approx(0.02)
    assert found.half == pytest.approx(1.96 * np.sqrt(49 / 4 / 5880**2 / 2))


@pytest.mark.parametrize("name", list(policies()))
def test_every_run_is_a_valid_configuration(name: str) -> None:
    check_config(configure(policies()[name], 1))


@pytest.mark.parametrize("ramp", [CONSERVATIVE, Ramp(60, 1)])
def test_a_run_earns_what_its_switch_makes_exact(ramp: Ramp) -> None:
    """The world, the learner and the agent together; the bound is 4 standard deviations of the arms' chance.

    The jump's only chance is in the first unit, without a policy: the bound is 0.0024, and acting on
    beta_0 = 0 there would earn 0.0042 more or less. A unit's policy is there 3 ticks early: at most 0.0005.
    """
    seen = run(ramp, 1)
    chance = rewards_given(acted(ramp), seen.first)
    sd = np.sqrt((chance * (1 - chance)).mean() / (UNITS * REWARDS))
    assert seen.average == pytest.approx(chance.mean(), abs=4 * sd)
    assert abs(seen.average - (1 - chance).mean()) > 8 * sd  # the arms the other way round


def test_the_picture(tmp_path: Path) -> None:
    ramps = {name: ramp for name, ramp in policies().items() if ramp is not None}
    draw(tmp_path / "m.png", UNITS, ramps, {"best": (0.75, 0.01)})
    assert (tmp_path / "m.png").read_bytes().startswith(b"\x89PNG")
