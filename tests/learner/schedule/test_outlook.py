"""What the algorithms foresee of a window, against what they then do."""

from __future__ import annotations

import math

import numpy as np
import pytest

from learner.replay import Replay
from learner.tabular.npg import Npg
from learner.tabular.q import QLearning
from rtcore.config import ScheduleConfig
from tests.learner.fsac_student import in_second_window, make_fsac
from tests.learner.small import forq, small_config
from tests.learner.tabular.lived import BANDIT, pull, table_config, window


def npg(rewards: tuple[float, ...], **forecast: object) -> Npg:
    """One pull of arm 0 in each unit; Q(0) is the newest reward. gamma = 1/2, tau = 1, eta = 1/4."""
    replay = Replay(100, 1, 1)
    table = {"step_size": 1.0, "epsilon": 0.0, "eta": 0.25, "entropy": 1.0}
    config = table_config("npg", forecast={"kind": "forq", "l_p": 3} | forecast, **table)
    found = Npg(config, BANDIT, 0, replay)
    for unit, reward in enumerate(rewards):
        pull(replay, 0, reward, unit=unit)
        found.update(improve_policy=True)
        found.end_unit(unit)
    return found


def test_nothing_is_foreseen_without_a_past() -> None:
    assert npg(()).outlook(0, 4) is None
    assert QLearning(table_config("q"), BANDIT, 0, Replay(9, 1, 1)).outlook(0, 4) is None
    assert make_fsac().outlook(0, 4) is None


def test_npg_foresees_q_on_its_line_and_the_target_at_its_horizon() -> None:
    found = npg((1.0, 2.0, 3.0)).outlook(3, 2)
    assert found is not None
    np.testing.assert_allclose(found.times, [-2.0, -1.0, 0.0])
    np.testing.assert_allclose(found.past[:, 0, 0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found.forecasts[:, 0], [[3.0, 0.0], [4.0, 0.0], [5.0, 0.0]])
    np.testing.assert_allclose(found.target, [[5.0, 0.0]])
    nearer = npg((1.0, 2.0, 3.0), horizon=1.0).outlook(3, 2)
    assert nearer is not None
    np.testing.assert_allclose(nearer.target, [[4.0, 0.0]])
    untrusted = npg((1.0, 2.0, 3.0), trust="never").outlook(3, 2)
    assert untrusted is not None
    np.testing.assert_allclose(untrusted.forecasts[:, 0, 0], 3.0)


def test_the_policies_foreseen_are_those_that_are_made() -> None:
    found = npg((1.0, 2.0, 3.0))
    outlook = found.outlook(3, 4)
    assert outlook is not None
    found.begin_window(window(0, 3, 4, 0), 3)
    made = [found.policy_arrays()["probability"]]
    for g in range(1, 5):
        found.iterate(g)
        made.append(found.policy_arrays()["probability"])
    np.testing.assert_allclose(outlook.policies(), made, rtol=1e-6)


def test_looking_ahead_changes_nothing() -> None:
    looked, other = npg((1.0, 2.0, 3.0)), npg((1.0, 2.0, 3.0))
    looked.outlook(3, 4)
    a, b = looked.state(), other.state()
    assert a.scalars == b.scalars
    assert all(np.array_equal(a.tensors[name], b.tensors[name]) for name in b.tensors)


def test_the_regret_that_came_is_counted_like_the_one_foreseen() -> None:
    """Uniform at first, Q(0) = 0 in each unit and 4 at the last end: regret 4 / 2 where the arm pays."""
    found = npg((4.0,))
    found.begin_window(window(0, 1, 2, 0), 1)  # k = 0: uniform against (4, 0): 2
    assert "schedule/realised" not in found.metrics()
    found.end_unit(1)  # k = 1: nothing was improved meanwhile: 2
    found.end_unit(2)  # k = 2
    found.begin_window(window(1, 3, 2, 0), 3)
    assert found.metrics()["schedule/realised"] == pytest.approx(6.0)


def test_a_window_entered_midway_is_not_counted() -> None:
    found = npg((4.0,))
    found.begin_window(window(0, 0, 2, 0), 1)
    found.end_unit(1)
    found.begin_window(window(1, 2, 2, 0), 2)
    assert "schedule/realised" not in found.metrics()
    state = found.state()
    assert (state.scalars["realised"], state.scalars["looks"]) == (None, 1)
    again = npg((4.0,))
    again.load(state)
    assert again.state().scalars == state.scalars


def test_units_that_a_dead_learner_missed_make_no_whole_window() -> None:
    found = npg((4.0,))
    found.begin_window(window(0, 1, 2, 1), 1)
    found.end_unit(1)
    again = npg((4.0,))
    again.load(found.state())  # units 2 and 3 go by without it
    again.begin_window(window(1, 4, 2, 1), 4)
    assert "schedule/realised" not in again.metrics()


def test_fsac_foresees_on_a_batch_what_its_critics_forecast() -> None:
    schedule = ScheduleConfig(rate=0.25)
    fsac = in_second_window(small_config(algo="fsac", forecast=forq(), schedule=schedule))
    found = fsac.outlook(4, 3)
    assert found is not None
    states, candidates = small_config().batch, 16
    snapshots = len(fsac._history.snapshots)
    assert found.past.shape == (snapshots, states, candidates)
    assert found.forecasts.shape == (4, states, candidates)
    np.testing.assert_allclose(found.times, np.arange(1.0 - snapshots, 1.0))
    # a line through the past is straight: second differences of the forecasts are 0, and k = 0 is its end
    np.testing.assert_allclose(np.diff(found.forecasts, 2, axis=0), 0.0, atol=1e-9)
    slope = np.tensordot(found.times - found.times.mean(), found.past, 1)
    slope /= ((found.times - found.times.mean()) ** 2).sum()
    np.testing.assert_allclose(np.diff(found.forecasts, axis=0)[0], slope, atol=1e-9)
    # the candidates stand for the policy that drew them: uniform among themselves
    np.testing.assert_allclose(found.log_policy, -math.log(candidates))
    assert (found.rate, found.temperature) == (0.25, fsac._temperature.value)
    # as l_f = 4 was the forecast's horizon in `in_second_window`, the target looks 3 units ahead here
    towards = found.forecasts[-1] - found.target
    assert np.isfinite(towards).all()
    assert towards.std() > 0  # temperature times log pi of each candidate
