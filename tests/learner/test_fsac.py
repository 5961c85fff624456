"""What FSAC's policy climbs: SAC's Q without a forecast, the weighted sum of the copies with one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from learner.deep.sac import Sac
from rtcore.windows import Window
from tests.learner import formulas
from tests.learner.formulas import critic_value
from tests.learner.fsac_student import (
    WINDOW_1,
    climbed,
    in_second_window,
    learn_units,
    live_value,
    make_fsac,
    probe,
    same_bits,
    times,
    window,
)
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM, filled_replay, forq, small_config


@pytest.mark.parametrize("forecast", [forq(kind="none"), forq(trust="never")])
def test_without_a_forecast_it_is_sac_bit_for_bit(forecast: object) -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forecast))
    sac = Sac(small_config(), OBSERVATION_DIM, ACTION_DIM, 3, filled_replay())
    for student in (fsac, sac):
        for m in range(4):
            student.begin_window(window(m, 3), 3 * m)
            learn_units(student, range(3 * m, 3 * m + 3))
    assert sac.gradient_steps == 48
    for student in (fsac, sac):
        student.update(improve_policy=True)
        student.update(improve_policy=False)
    assert same_bits(sac, fsac)
    for name in ("batches", "noise"):
        assert sac.state().scalars["rng"][name] == fsac.state().scalars["rng"][name]


def test_without_forecasts_nothing_is_said_of_them() -> None:
    fsac = in_second_window(small_config(algo="fsac", forecast=forq(kind="none")))
    assert not [name for name in fsac.metrics() if name.startswith("forecast/")]


def test_with_a_forecast_it_is_not_sac() -> None:
    fsac = in_second_window()
    sac = Sac(small_config(), OBSERVATION_DIM, ACTION_DIM, 3, filled_replay())
    learn_units(sac, range(4))
    assert same_bits(sac, fsac)
    for student in (fsac, sac):
        student.update(improve_policy=True)
    assert same_bits(sac, fsac, "critic.")  # the forecast is in the policy's loss alone
    assert same_bits(sac, fsac, "target.")
    assert same_bits(sac, fsac, "temperature.")
    assert not same_bits(sac, fsac, "actor.")


def test_true_copies_do_not_move_when_the_critic_trains() -> None:
    fsac = make_fsac()
    learn_units(fsac, range(1))
    (copy,) = fsac._history.snapshots
    at_end = critic_value(copy.parameters, *probe())
    torch.testing.assert_close(at_end, live_value(fsac), rtol=0, atol=0)
    learn_units(fsac, range(1, 3))
    assert torch.equal(critic_value(copy.parameters, *probe()), at_end)
    assert not torch.equal(live_value(fsac), at_end)


def test_the_policy_climbs_the_weighted_sum_of_the_copies() -> None:
    fsac = in_second_window()
    # times -2, -1, 0 and t_q = 4, the window's length: 1/3 + (4 + 1) * (-1, 0, 1) / 2
    weights = [1 / 3 - 2.5, 1 / 3, 1 / 3 + 2.5]
    assert times(fsac) == [2, 3, 4]
    values = torch.stack(
        [critic_value(snapshot.parameters, *probe()) for snapshot in fsac._history.snapshots]
    )
    wanted = (torch.tensor(weights)[:, None] * values).sum(0)
    torch.testing.assert_close(climbed(fsac), wanted, rtol=1e-5, atol=1e-5)
    seen = fsac.metrics()
    assert seen["forecast/weight_norm"] == pytest.approx(float(np.linalg.norm(weights)))
    assert (seen["forecast/horizon"], seen["forecast/snapshots"]) == (4.0, 3.0)


def test_the_actor_descends_on_the_forecast_loss() -> None:
    fsac, twin = in_second_window(), make_fsac(seed=8)
    twin.load(fsac.state())
    fsac.update(improve_policy=True)
    twin._draw_batch()
    alpha, observation = twin.metrics()["alpha"], twin._sampled.observation
    now, _ = twin._propose_both()
    leaves = {
        name: view.clone().requires_grad_() for name, view in twin._actor.views(twin._actor.flat).items()
    }
    noise = torch.from_numpy(twin._noise[: len(observation)])
    action, log_prob = formulas.squashed_gaussian(formulas.mlp(leaves, observation)[0], noise)
    torch.testing.assert_close(action, now.action)
    past = [critic_value(snapshot.parameters, observation, action) for snapshot in twin._history.snapshots]
    value = -13 / 6 * past[0] + 1 / 3 * past[1] + 17 / 6 * past[2]  # weights as above
    loss = (alpha * log_prob - value).mean()
    assert fsac.metrics()["loss/actor"] == pytest.approx(loss.item(), rel=1e-4)
    wanted = torch.autograd.grad(loss, list(leaves.values()))
    for found, gradient in zip(fsac._actor.views(fsac._actor.grad).values(), wanted, strict=True):
        torch.testing.assert_close(found, gradient, rtol=1e-3, atol=1e-5)


def test_the_forecast_stays_while_the_window_lasts() -> None:
    fsac = in_second_window()
    before = climbed(fsac)
    learn_units(fsac, range(4, 7))
    fsac.begin_window(WINDOW_1, 6)  # entered again, after a restart
    assert torch.equal(climbed(fsac), before)
    learn_units(fsac, range(7, 8))
    fsac.begin_window(Window(m=2, start=8, update=3, hold=1), 8)
    assert not torch.equal(climbed(fsac), before)
