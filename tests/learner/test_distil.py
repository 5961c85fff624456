from __future__ import annotations

import numpy as np
import pytest
import torch

from learner.deep.distil import FIRST_FITS, FIT_EVERY, Distilled
from learner.deep.networks import make_networks
from tests.learner import formulas

ROWS, ACTION, WIDTHS = 64, 2, [5, 16, 16, 1]


def made(precision: torch.dtype = torch.float32) -> Distilled:
    return Distilled(WIDTHS, ROWS, precision)


def inputs(seed: int = 0) -> torch.Tensor:
    return torch.randn(ROWS, WIDTHS[0], generator=torch.Generator().manual_seed(seed))


def test_it_begins_with_the_weights_applied_to_the_first_critics_parameters() -> None:
    distilled = made()
    old, new = (make_networks(2, WIDTHS, np.random.default_rng(seed)) for seed in (0, 1))
    distilled.restart((-1.0, 2.0), (old, new))
    found = distilled.parameters.views(distilled.parameters.flat)
    for name, view in found.items():
        wanted = 2 * new.views(new.flat)[name][0] - old.views(old.flat)[name][0]
        torch.testing.assert_close(view[0], wanted)


def test_one_snapshot_is_itself() -> None:
    distilled, critic = made(), make_networks(2, WIDTHS, np.random.default_rng(0))
    distilled.restart((1.0,), (critic,))
    plain = inputs().requires_grad_()
    wanted = formulas.mlp(critic.views(critic.flat), plain)[0, :, 0]
    torch.autograd.backward(wanted.sum())
    value, slope = distilled.climb(inputs(), ACTION)
    torch.testing.assert_close(value, wanted.detach())
    assert plain.grad is not None
    torch.testing.assert_close(slope, plain.grad[:, -ACTION:])


def test_the_first_steps_are_exact_and_then_every_so_many() -> None:
    distilled, exact = made(), []
    for step in range(FIRST_FITS + 3 * FIT_EVERY):
        if distilled.due():
            exact.append(step)
        distilled.steps += 1
    assert exact[:FIRST_FITS] == list(range(FIRST_FITS))
    assert exact[FIRST_FITS:] == [32, 48, 64]


def test_the_error_is_in_spreads_and_comes_before_the_fit() -> None:
    distilled = made()  # 0 everywhere
    value = torch.tensor([3.0, 5.0] * (ROWS // 2))  # mean square 17, variance 1 * 64 / 63
    distilled.fit(inputs(), value, torch.ones(ROWS, ACTION))
    assert distilled.judged()["forecast/distil_error"] == pytest.approx((17 * 63 / 64) ** 0.5, rel=1e-5)
    assert distilled.judged()["forecast/distil_slope"] == 0.0


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16])
def test_it_comes_closer_on_batches_it_has_not_seen(precision: torch.dtype) -> None:
    distilled = made(precision)
    teacher, start = (make_networks(2, WIDTHS, np.random.default_rng(seed)) for seed in (1, 2))
    distilled.restart((1.0,), (start,))
    errors, slopes = [], []
    for seed in range(400):
        batch = inputs(seed).requires_grad_()
        value = 10 * formulas.mlp(teacher.views(teacher.flat), batch)[..., 0].min(0).values
        torch.autograd.backward(value.sum())
        assert batch.grad is not None
        distilled.fit(batch.detach(), value.detach(), batch.grad[:, -ACTION:])
        errors.append(distilled.judged()["forecast/distil_error"])
        slopes.append(distilled.judged()["forecast/distil_slope"])
    assert np.mean(errors[-20:]) < 0.4 * np.mean(errors[:20])
    assert np.mean(slopes[-20:]) > np.mean(slopes[:20]) + 0.3


def test_a_restart_forgets_the_optimiser_and_the_judgement() -> None:
    distilled, critic = made(), make_networks(2, WIDTHS, np.random.default_rng(0))
    distilled.fit(inputs(), torch.ones(ROWS), torch.ones(ROWS, ACTION))
    distilled.steps = 7
    distilled.restart((1.0,), (critic,))
    assert (distilled.steps, distilled.adam.steps.item(), distilled.judged()) == (0, 0.0, {})
    assert distilled.adam.moment1.abs().sum() == distilled.adam.moment2.abs().sum() == 0
