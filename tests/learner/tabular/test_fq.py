"""Q-learning with a forecast: two past tables of a bandit, extrapolated by hand.

With step size 1 and one-step episodes Q(a) is the last reward of arm a. Arm 0 pays 3 in unit 0 and 2 in
unit 1, arm 1 is never pulled and stays at 1.5. Past tables: at t = 1 and t = 2. In the window [2, 5) the
horizon is 3, and the line through (1, 3) and (2, 2) is at -1 when t = 5. The weights: x = (-1, 0), query
3, mean -1/2, Sxx = 1/2, so w = 1/2 -+ 3.5 * 0.5 / 0.5 = (-3, 4).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from learner.replay import Replay
from learner.tabular.fq import Fq
from tests.learner.tabular.lived import BANDIT, pull, table_config, window

FIRST = window(1, 2, 2, 1)


def lived(*, forecast: dict[str, Any] | None = None, **table: Any) -> tuple[Fq, Replay]:
    """At the start of unit 2, before its window is entered."""
    replay = Replay(100, 1, 1)
    fields = {"step_size": 1.0, "epsilon": 0.2, "initial": 1.5} | table
    found = Fq(table_config("fq", forecast=forecast or {}, **fields), BANDIT, 0, replay)
    found.begin_window(window(0, 0, 2, 0), 0)
    for unit, reward in enumerate((3.0, 2.0)):
        pull(replay, 0, reward, unit=unit)
        found.update(improve_policy=True)
        found.end_unit(unit)
    return found, replay


def acts(found: Fq) -> list[float]:
    return [round(float(p), 6) for p in found.policy_arrays()["probability"][0]]


def q_of(found: Fq) -> list[float]:
    return found.state().tensors["q"][0].tolist()  # type: ignore[no-any-return]


def forecast_of(found: Fq) -> list[float]:
    return found.state().tensors["forecast.value"][0].tolist()  # type: ignore[no-any-return]


def test_before_there_is_a_forecast_it_is_q() -> None:
    found, _ = lived()
    assert acts(found) == [0.9, 0.1]  # 2 against 1.5
    assert found.policy_steps == 2


def test_the_policy_is_greedy_in_the_extrapolated_table() -> None:
    found, _ = lived()
    found.begin_window(FIRST, 2)
    assert forecast_of(found) == pytest.approx([-1.0, 1.5])  # -3 * 3 + 4 * 2
    assert acts(found) == [0.1, 0.9]
    assert q_of(found) == [2.0, 1.5]
    metrics = found.metrics()
    assert metrics["forecast/weight_norm"] == pytest.approx(5.0)  # of (-3, 4)
    assert (metrics["forecast/horizon"], metrics["forecast/snapshots"]) == (3.0, 2.0)


def test_it_stays_for_the_window_while_q_learns() -> None:
    found, replay = lived()
    assert found.iterate(2)  # of the window before
    found.begin_window(FIRST, 2)
    assert found.iterate(1)
    pull(replay, 0, 50.0, unit=2)
    found.update(improve_policy=True)
    assert not found.iterate(2)
    assert acts(found) == [0.1, 0.9]
    found.end_unit(2)
    found.begin_window(FIRST, 3)  # asked again, as after a restart
    assert (acts(found), found.policy_steps, found.gradient_steps) == ([0.1, 0.9], 3, 3)


def test_the_forecast_may_be_written_into_the_table() -> None:
    found, _ = lived(write_back=0.25)
    found.begin_window(FIRST, 2)
    assert q_of(found) == pytest.approx([1.25, 1.5])  # 0.75 * 2 - 0.25 * 1
    assert forecast_of(found) == pytest.approx([-1.0, 1.5])


def test_a_forecast_is_judged_where_there_was_something_to_see() -> None:
    found, replay = lived(forecast={"trust": "judged"})
    found.begin_window(FIRST, 2)
    assert acts(found) == [0.9, 0.1]  # no trust has been earned yet: Q at t_m
    for unit in (2, 3, 4):
        pull(replay, 0, 0.0, unit=unit)
        found.update(improve_policy=True)
        found.end_unit(unit)
    found.begin_window(window(2, 5, 2, 1), 5)
    metrics = found.metrics()
    # arm 0 alone: -1 was forecast, 0 was reached, and Q at t_m was 2
    assert metrics["forecast/windows"] == 1
    assert metrics["forecast/error"] == pytest.approx(1.0)
    assert metrics["forecast/baseline_error"] == pytest.approx(2.0)
    assert metrics["forecast/trust"] == pytest.approx(0.15)  # 0.3 * (1 - 1/2)


def test_a_farther_forecast_is_judged_where_the_window_ends() -> None:
    found, replay = lived(forecast={"horizon": 10.0})
    found.begin_window(FIRST, 2)
    assert forecast_of(found) == pytest.approx([-8.0, 1.5])  # the line at t = 12
    for unit in (2, 3, 4):
        pull(replay, 0, 0.0, unit=unit)
        found.update(improve_policy=True)
        found.end_unit(unit)
    found.begin_window(window(2, 5, 2, 1), 5)
    assert found.metrics()["forecast/error"] == pytest.approx(1.0)  # -1 at t = 5, and 0 was reached


def test_trust_shrinks_the_forecast_towards_the_table() -> None:
    found, _ = lived(forecast={"trust": "judged"})
    found._forecaster._judge.hear(0.0, 1.0)  # perfect once: rho = 0.3
    found.begin_window(FIRST, 2)
    live = np.array([[2.0, 1.5]])
    assert found._forecaster.trusted(live)[0].tolist() == pytest.approx([1.1, 1.5])  # 0.3 * -1 + 0.7 * 2
    live[0, 0] = 4.0  # Q goes on
    assert found._forecaster.trusted(live)[0].tolist() == pytest.approx([2.5, 1.5])


def test_partly_trusted_it_moves_with_q_within_the_window() -> None:
    found, replay = lived(forecast={"trust": "judged"})
    found._forecaster._judge.hear(0.0, 1.0)
    found.begin_window(FIRST, 2)
    assert acts(found) == [0.1, 0.9]  # 1.1 against 1.5
    found.iterate(1)
    pull(replay, 0, 4.0, unit=2)
    found.update(improve_policy=True)
    assert acts(found) == [0.9, 0.1]  # 2.5 against 1.5
    assert found.iterate(2)


def test_never_trusted_it_is_q_learning() -> None:
    found, replay = lived(forecast={"trust": "never"})
    found.begin_window(FIRST, 2)
    pull(replay, 0, 0.0, unit=2)
    found.update(improve_policy=True)
    assert acts(found) == [0.1, 0.9]  # 0 against 1.5
    assert found.iterate(1)


def test_a_window_cut_short_is_not_judged() -> None:
    found, _ = lived()
    found.begin_window(FIRST, 2)
    found.begin_window(window(2, 5, 2, 1), 6)  # the learner was away while it began
    assert found.metrics()["forecast/windows"] == 0


def test_one_table_is_kept_every_so_many_units() -> None:
    replay = Replay(100, 1, 1)
    found = Fq(table_config("fq", forecast={"every": 2}, step_size=1.0), BANDIT, 0, replay)
    for unit in range(7):
        pull(replay, 0, float(unit), unit=unit)
        found.update(improve_policy=True)
        found.end_unit(unit)
    state = found.state()
    assert state.scalars["history"] == [4, 6]  # the newest two
    assert [state.tensors[f"history.{time}"][0, 0] for time in (4, 6)] == [3.0, 5.0]


def test_a_unit_that_ends_again_replaces_what_was_kept() -> None:
    found, replay = lived()
    pull(replay, 0, 9.0, unit=0)
    found.update(improve_policy=True)
    found.end_unit(0)
    state = found.state()
    assert state.scalars["history"] == [1]
    assert state.tensors["history.1"][0, 0] == 9.0


def test_the_horizon_may_count_the_age_of_what_was_learned() -> None:
    # the only reward in Q(0) is of unit 1, 1.5 on average, and half a unit old at t_m = 2
    found, _ = lived(forecast={"horizon": "replay"})
    found.begin_window(FIRST, 2)
    assert found.metrics()["forecast/horizon"] == pytest.approx(3.5)
    assert forecast_of(found) == pytest.approx([-1.5, 1.5])


def test_age_weighs_rewards_as_the_table_does() -> None:
    # step size 1/4: first 0.5, then 0.5 + 1/4 * (1.5 - 0.5) = 0.75; at t_m = 2 that is 1.25 units ago
    found, _ = lived(forecast={"horizon": "replay"}, step_size=0.25)
    found.begin_window(FIRST, 2)
    assert found.metrics()["forecast/horizon"] == pytest.approx(4.25)


def test_without_a_forecast_it_is_q() -> None:
    found, replay = lived(forecast={"kind": "none"})
    found.begin_window(FIRST, 2)
    assert acts(found) == [0.9, 0.1]
    pull(replay, 0, -1.0, unit=2)
    found.update(improve_policy=True)
    assert acts(found) == [0.1, 0.9]
    assert found.policy_steps == found.gradient_steps == 3
    assert not any(name.startswith("forecast/") for name in found.metrics())


def test_an_empty_table_is_no_material() -> None:
    found = Fq(table_config("fq", forecast={}), BANDIT, 0, Replay(10, 1, 1))
    found.end_unit(0)
    found.begin_window(window(1, 1, 1, 0), 1)
    assert found.state().scalars["history"] == []
    assert np.isfinite(list(found.metrics().values())).all()
