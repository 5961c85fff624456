"""How FSAC's forecast is judged by the critic reached, and trusted for it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from learner.deep.fsac import Fsac
from learner.deep.sac import Sac
from learner.replay import Replay
from rtcore.windows import Window
from tests.learner.fsac_student import (
    WINDOW_1,
    climbed,
    in_second_window,
    learn_units,
    live_value,
    make_fsac,
    probe,
    same_bits,
    window,
)
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM, filled_replay, forq, small_config


def set_constant_critic(fsac: Fsac, value: float) -> None:
    """Q(s, a) = value everywhere."""
    fsac._critic.flat.zero_()
    fsac._critic.views(fsac._critic.flat)["2.bias"].fill_(value)


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
