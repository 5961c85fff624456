from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest
import torch

from learner.deep.distil import FIRST_FITS
from learner.deep.fsac import Fsac
from learner.deep.sac import Sac
from learner.replay import Replay
from rtcore.config import LearnerConfig
from rtcore.windows import Window
from tests.learner import formulas
from tests.learner.formulas import critic_value
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM, filled_replay, forq, small_config

UPDATES_PER_UNIT = 4
WINDOW_0, WINDOW_1 = Window(m=0, start=0, update=3, hold=1), Window(m=1, start=4, update=3, hold=1)


def make_fsac(config: LearnerConfig | None = None, seed: int = 3) -> Fsac:
    config = config or small_config(algo="fsac", forecast=forq())
    return Fsac(config, OBSERVATION_DIM, ACTION_DIM, seed, filled_replay())


def learn_units(student: Sac, units: range) -> None:
    for unit in units:
        for _ in range(UPDATES_PER_UNIT):
            student.update(improve_policy=True)
        student.end_unit(unit)


def in_second_window(config: LearnerConfig | None = None) -> Fsac:
    fsac = make_fsac(config)
    fsac.begin_window(WINDOW_0, 0)
    learn_units(fsac, range(4))
    fsac.begin_window(WINDOW_1, 4)
    return fsac


def probe() -> tuple[torch.Tensor, torch.Tensor]:
    """A batch of observations and actions."""
    rows = small_config().batch
    observation = torch.linspace(-1, 1, rows * OBSERVATION_DIM).view(rows, OBSERVATION_DIM)
    return observation, torch.linspace(-0.9, 0.9, rows * ACTION_DIM).view(rows, ACTION_DIM)


def climbed(fsac: Fsac) -> torch.Tensor:
    """The Q that the policy climbs, at the probe."""
    fsac._enter(*probe())
    return fsac._climb()[0]


def live_value(fsac: Fsac) -> torch.Tensor:
    return critic_value(fsac._critic, *probe())


def same_bits(first: Sac, second: Sac, prefix: str = "") -> bool:
    a, b = first.state().tensors, second.state().tensors
    names = [name for name in a if name.startswith(prefix) and not name.startswith("history.")]
    assert names
    return all(a[name].tobytes() == b[name].tobytes() for name in names)


def times(fsac: Fsac) -> list[int]:
    return [snapshot.time for snapshot in fsac._history.snapshots]


def set_constant_critic(fsac: Fsac, value: float) -> None:
    """Q(s, a) = value everywhere."""
    fsac._critic.flat.zero_()
    fsac._critic.views(fsac._critic.flat)["2.bias"].fill_(value)


def window(m: int, length: int = 4) -> Window:
    return Window(m=m, start=length * m, update=length - 1, hold=1)


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


def test_it_uses_the_snapshots_there_are() -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forq(l_p=10)))
    fsac.begin_window(WINDOW_0, 0)
    assert fsac.metrics()["forecast/snapshots"] == 0
    torch.testing.assert_close(climbed(fsac), live_value(fsac))
    learn_units(fsac, range(2))
    fsac.begin_window(WINDOW_1, 4)
    assert fsac.metrics()["forecast/snapshots"] == 2


def test_critics_that_have_not_learnt_are_not_kept() -> None:
    fsac = make_fsac()
    fsac.end_unit(0)
    assert times(fsac) == []
    fsac.update(improve_policy=True)
    fsac.end_unit(1)
    assert times(fsac) == [2]


def test_a_unit_that_ends_again_replaces_what_came_after() -> None:
    fsac = make_fsac()
    learn_units(fsac, range(3))
    fsac.end_unit(1)
    assert times(fsac) == [1, 2]


@pytest.mark.parametrize(
    ("entered", "configured", "horizon"),
    [
        (Window(m=1, start=4, update=3, hold=2), "window", 5.0),
        (Window(m=1, start=4, update=3, hold=None), "window", 3.0),
        (Window(m=1, start=4, update=3, hold=2), 12.5, 12.5),
    ],
)
def test_the_horizon(entered: Window, configured: float | Literal["window"], horizon: float) -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forq(horizon=configured)))
    learn_units(fsac, range(4))
    fsac.begin_window(entered, 4)
    assert fsac.metrics()["forecast/horizon"] == horizon


def test_snapshots_are_kept_every_so_many_units() -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forq(every=3, l_p=2)))
    fsac.begin_window(WINDOW_0, 0)
    learn_units(fsac, range(10))
    assert times(fsac) == [6, 9]
    fsac.begin_window(Window(m=1, start=10, update=3, hold=1), 10)
    # the line through -4 and -1, read at 4: (-5/3, 8/3)
    assert fsac._forecast is not None
    assert fsac._forecast.weights == pytest.approx((-5 / 3, 8 / 3))
    assert fsac._forecast.before.time == 10  # the newest snapshot is not the critic at t_m
    torch.testing.assert_close(
        critic_value(fsac._forecast.before.parameters, *probe()), live_value(fsac), rtol=0, atol=0
    )


@pytest.mark.parametrize(
    ("fields", "age"),
    [
        ({}, 10 - (4.5 + 0.5)),  # units 0..9, ten transitions in each
        ({"replay_units": 1.0}, 10 - (8.5 + 0.5)),
        ({"replay_recency": 1e9, "replay_units": 2.0}, 10 - ((8.5 + 7) / 2 + 0.5)),  # 8 and 9, and 7
    ],
)
def test_the_horizon_counts_the_age_of_the_replay(fields: dict[str, float], age: float) -> None:
    config = small_config(algo="fsac", forecast=forq(horizon="replay"), **fields)
    fsac = Fsac(config, OBSERVATION_DIM, ACTION_DIM, 3, filled_replay(100, per_unit=10))
    learn_units(fsac, range(9, 10))
    fsac.begin_window(Window(m=1, start=10, update=3, hold=1), 10)
    assert fsac.metrics()["forecast/horizon"] == pytest.approx(4 + age)


def test_a_forecast_is_judged_by_the_critic_reached() -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forq(l_p=2)))
    fsac.update(improve_policy=True)
    for unit, value in ((2, 1.0), (3, 2.0)):
        set_constant_critic(fsac, value)
        fsac.end_unit(unit)
    fsac.begin_window(WINDOW_1, 4)  # a line through 1, 2: Qtilde = 6 at t = 8
    assert climbed(fsac).tolist() == pytest.approx([6.0] * 32, abs=1e-5)
    set_constant_critic(fsac, 5.5)
    fsac.end_unit(7)
    fsac.begin_window(Window(m=2, start=8, update=3, hold=1), 8)
    seen = fsac.metrics()
    assert seen["forecast/windows"] == 1
    assert seen["forecast/error"] == pytest.approx(0.5, abs=1e-5)
    assert seen["forecast/baseline_error"] == pytest.approx(3.5, abs=1e-5)


def test_a_forecast_that_looks_further_is_judged_where_its_window_ends() -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forq(l_p=2, horizon=10.0)))
    fsac.update(improve_policy=True)
    for unit, value in ((2, 1.0), (3, 2.0)):
        set_constant_critic(fsac, value)
        fsac.end_unit(unit)
    fsac.begin_window(WINDOW_1, 4)  # a line through 1, 2: 12 at t = 14, which is climbed, 6 at t = 8
    assert climbed(fsac).tolist() == pytest.approx([12.0] * 32, abs=1e-5)
    set_constant_critic(fsac, 6.0)
    fsac.begin_window(window(2), 8)
    assert fsac.metrics()["forecast/error"] == pytest.approx(0.0, abs=1e-5)


def test_it_is_judged_on_actions_that_nothing_learnt_from() -> None:
    replay = Replay(100, OBSERVATION_DIM, ACTION_DIM)
    for number in range(50):
        state = np.full(OBSERVATION_DIM, number, np.float32)
        replay.add(state, np.full(ACTION_DIM, 0.25, np.float32), 0.0, state, False, 0)
    fsac = Fsac(small_config(algo="fsac", forecast=forq()), OBSERVATION_DIM, ACTION_DIM, 3, replay)
    learn_units(fsac, range(4))
    fsac.begin_window(WINDOW_1, 4)
    assert fsac._forecast is not None
    fsac._judge_forecast(fsac._forecast)
    states, actions = fsac._values.input[:, :OBSERVATION_DIM], fsac._values.input[:, OBSERVATION_DIM:]
    assert set(states[:, 0].tolist()) <= set(range(50))
    assert len(set(actions.flatten().tolist()) - {0.25}) == 32 * ACTION_DIM
    uniform = actions[16:].abs()
    assert uniform.max() <= 1
    assert uniform.mean() == pytest.approx(0.5, abs=0.2)


def test_judging_leaves_the_learning_alone() -> None:
    judged, other = in_second_window(), in_second_window()
    for student in (judged, other):
        learn_units(student, range(4, 8))
    assert judged._forecast is not None
    judged._judge_forecast(judged._forecast)
    for student in (judged, other):
        student._forecast = None
        learn_units(student, range(8, 9))
    assert same_bits(judged, other)


def drift(fsac: Fsac, windows: range, parameters: Callable[[int], torch.Tensor]) -> list[float]:
    """Go through `windows` with critics whose parameters are so at the end of each unit; their trust."""
    shares = []
    for m in windows:
        fsac.begin_window(window(m), 4 * m)
        shares.append(fsac._judge.share)
        for unit in range(4 * m, 4 * m + 4):
            fsac._critic.flat.copy_(parameters(unit))
            fsac.end_unit(unit)
    return shares


def test_trust_grows_where_q_drifts_along_a_line_and_is_lost_on_noise() -> None:
    fsac = make_fsac(small_config(algo="fsac", forecast=forq(trust="judged", l_p=5)))
    fsac.update(improve_policy=True)
    start, noise = fsac._critic.flat.clone(), torch.Generator().manual_seed(0)

    def along_a_line(unit: int) -> torch.Tensor:  # Q rises by 0.25 a unit, everywhere
        fsac._critic.flat.copy_(start)
        fsac._critic.views(fsac._critic.flat)["2.bias"].add_(0.25 * unit)
        return fsac._critic.flat.clone()

    def white(unit: int) -> torch.Tensor:
        del unit
        return start + 0.1 * torch.randn(start.shape, generator=noise)

    shares = drift(fsac, range(10), along_a_line)
    # the first forecast, in window 1, knows 4 of 5 snapshots, and the line: 1 - 0.7^k after k windows
    assert shares == pytest.approx([0, 0] + [1 - 0.7**k for k in range(1, 9)], abs=1e-3)
    seen = fsac.metrics()
    assert seen["forecast/last_baseline_error"] == pytest.approx(1.0, rel=1e-3)  # four units
    assert seen["forecast/last_error"] < 1e-4
    before = fsac._judge.state()
    lost = drift(fsac, range(10, 35), white)
    after = fsac._judge.state()
    assert after["windows"] - before["windows"] == 25
    error, baseline = (after[name] - before[name] for name in ("error_sum", "baseline_error_sum"))
    # of a critic's noise: (1 + |w|^2)^0.5 = (1 + 0.2 + 12 * 36 / 120)^0.5 = 2.2 against 2^0.5
    assert error > 1.4 * baseline
    assert max(lost[-10:]) < 0.1  # 0, but for windows in which noise happened to fall on its line


def test_the_policy_follows_the_forecast_as_far_as_it_is_trusted() -> None:
    fsac = in_second_window(small_config(algo="fsac", forecast=forq(trust="judged")))
    torch.testing.assert_close(climbed(fsac), live_value(fsac))  # not earned yet
    fsac._judge.hear(1.0, 2.0)  # rho = 0.3 * 0.5
    whole = in_second_window()
    wanted = 0.15 * climbed(whole) + 0.85 * live_value(fsac)
    torch.testing.assert_close(climbed(fsac), wanted, rtol=1e-5, atol=1e-5)
    inputs = [part.clone() for part in probe()]
    for student in (fsac, whole):
        student._enter(*inputs)
    slopes = [student._climb()[1] for student in (fsac, whole)]
    live = Sac._climb(fsac)[1]
    torch.testing.assert_close(slopes[0], 0.15 * slopes[1] + 0.85 * live, rtol=1e-4, atol=1e-5)


def test_a_forecast_not_trusted_yet_is_sac_bit_for_bit() -> None:
    fsac = in_second_window(small_config(algo="fsac", forecast=forq(trust="judged")))
    sac = Sac(small_config(), OBSERVATION_DIM, ACTION_DIM, 3, filled_replay())
    learn_units(sac, range(4))
    for student in (fsac, sac):
        learn_units(student, range(4, 8))
    assert fsac.metrics()["forecast/snapshots"] == 3
    assert same_bits(sac, fsac)


def test_a_forecast_is_not_judged_late() -> None:
    fsac = in_second_window()
    learn_units(fsac, range(4, 9))
    fsac.begin_window(Window(m=2, start=8, update=3, hold=1), 9)
    assert fsac.metrics()["forecast/windows"] == 0


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
