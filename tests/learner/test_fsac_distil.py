"""FSAC's forecast distilled into one network."""

from __future__ import annotations

import torch

from learner.deep.distil import FIRST_FITS
from rtcore.windows import Window
from tests.learner import formulas
from tests.learner.fsac_student import (
    UPDATES_PER_UNIT,
    climbed,
    in_second_window,
    learn_units,
    make_fsac,
    probe,
    same_bits,
)
from tests.learner.small import forq, small_config


def test_a_distilled_forecast_takes_over_after_the_exact_steps() -> None:
    fsac = in_second_window(small_config(algo="fsac", forecast=forq(distil=True)))
    exact = in_second_window()
    assert fsac._distilled is not None
    assert torch.equal(climbed(fsac), climbed(exact))
    fsac._distilled.steps = FIRST_FITS + 1
    taken_over = climbed(fsac)
    assert not torch.equal(taken_over, climbed(exact))
    wanted = formulas.mlp(
        fsac._distilled.parameters.views(fsac._distilled.parameters.flat), torch.cat(probe(), -1)
    )
    torch.testing.assert_close(taken_over, wanted[0, :, 0])
    assert {"forecast/distil_error", "forecast/distil_slope"} <= fsac.metrics().keys()


def test_distilling_needs_no_random_numbers_and_leaves_the_critics_alone() -> None:
    distilled = in_second_window(small_config(algo="fsac", forecast=forq(distil=True)))
    exact = in_second_window()
    assert distilled._distilled is not None
    distilled._distilled.steps = FIRST_FITS + 1
    for student in (distilled, exact):
        student.update(improve_policy=True)
    assert same_bits(exact, distilled, "critic.")
    assert not same_bits(exact, distilled, "actor.")
    assert exact.state().scalars["rng"] == distilled.state().scalars["rng"]


def test_a_new_window_begins_a_new_fit() -> None:
    fsac = in_second_window(small_config(algo="fsac", forecast=forq(distil=True)))
    learn_units(fsac, range(4, 8))
    assert fsac._distilled is not None
    assert fsac._distilled.steps == 4 * UPDATES_PER_UNIT
    fsac.begin_window(Window(m=2, start=8, update=3, hold=1), 8)
    assert fsac._distilled.steps == 0
    assert "forecast/distil_error" not in fsac.metrics()


def test_a_distilled_forecast_outlives_the_process() -> None:
    config = small_config(algo="fsac", forecast=forq(distil=True), precision="bfloat16")
    before, after = in_second_window(config), make_fsac(config, seed=8)
    learn_units(before, range(4, 5))
    assert before._distilled is not None
    assert after._distilled is not None
    before._distilled.steps = FIRST_FITS + 1
    after.load(before.state())
    assert after._distilled.steps == FIRST_FITS + 1
    assert torch.equal(climbed(after), climbed(before))
    for student in (before, after):
        learn_units(student, range(5, 12))  # with exact steps among them
    assert same_bits(before, after)
