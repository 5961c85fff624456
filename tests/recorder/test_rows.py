"""From messages to rows, without a file."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recorder.rows import Lines, Rows, Scalars, States, Timeline
from recorder.telemetry import TelemetryRows
from recorder.ticks import TickRows, speed_per_m
from rtcore.config import DriftConfig, EnvConfig, RewardConfig
from rtcore.messages import Event
from tests.recorder.stage import (
    MS,
    SPEC,
    T0,
    TICK,
    UNIT,
    WALL_T0,
    make_notice,
    make_policy,
    make_stats,
    make_step,
)


def scalars(tables: list[Rows], entity: str) -> tuple[list[int], list[list[float]]]:
    """Ticks and values of an entity's only table."""
    (table,) = [table for table in tables if table.entity == entity]
    assert isinstance(table.payload, Scalars)
    return table.index.tick.tolist(), table.payload.values.tolist()


def has(tables: list[Rows], entity: str) -> bool:
    return any(table.entity == entity for table in tables)


def test_a_stamp_lies_in_the_tick_and_unit_that_it_falls_into() -> None:
    timeline = Timeline(SPEC)
    index = timeline.of_stamps([T0 - 1, T0, T0 + TICK - 1, T0 + TICK, T0 + UNIT - 1, T0 + UNIT])
    assert index.run_time_ns.tolist() == [-1, 0, TICK - 1, TICK, UNIT - 1, UNIT]
    assert index.wall_ns.tolist() == [WALL_T0 + ns for ns in index.run_time_ns.tolist()]
    assert index.tick.tolist() == [0, 0, 0, 1, 49, 50]
    assert index.unit.tolist() == [0, 0, 0, 0, 0, 1]
    assert index.episode.tolist() == [0] * 6


def test_a_stamp_lies_in_the_episode_of_the_newest_step_until_then() -> None:
    timeline = Timeline(SPEC)
    timeline.remember([make_step(seq) for seq in range(25)])  # episodes begin at ticks 0, 10, 20
    stamps = [T0 - 5, T0 + 10 * TICK - 1, T0 + 10 * TICK, T0 + 20 * TICK, T0 + 900 * TICK]
    assert timeline.of_stamps(stamps).episode.tolist() == [0, 0, 1, 2, 2]


def test_a_step_brings_its_own_place() -> None:
    step = make_step(7, tick=31, episode=4, unit=9)  # as after overruns: nothing follows from the time alone
    index = Timeline(SPEC).of_steps([step])
    assert (index.tick[0], index.episode[0], index.unit[0]) == (31, 4, 9)
    assert index.run_time_ns[0] == 31 * TICK


def test_the_return_is_summed_over_batches_and_stands_at_the_last_tick() -> None:
    rows = TickRows(Timeline(SPEC))
    steps = [make_step(seq) for seq in range(21)]
    first, second, third = rows.rows(steps[:4]), rows.rows(steps[4:13]), rows.rows(steps[13:])
    assert not has(first, "/env/return")
    assert scalars(second, "/env/return") == ([9], [[-0.25 * 45]])  # 0 + 1 + ... + 9 = 45
    assert scalars(third, "/env/return") == ([19], [[-0.25 * 45]])


def test_a_terminated_episode_has_a_return_too() -> None:
    steps = [make_step(0), make_step(1), make_step(2, terminated=True)]
    assert scalars(TickRows(Timeline(SPEC)).rows(steps), "/env/return") == ([2], [[-0.75]])


def test_an_episode_with_a_lost_step_has_no_return_but_the_next_one_has() -> None:
    steps = [make_step(seq) for seq in range(30) if seq != 13]
    assert scalars(TickRows(Timeline(SPEC)).rows(steps), "/env/return")[0] == [9, 29]


def test_an_episode_met_midway_or_cut_by_a_restart_has_no_return() -> None:
    met_midway = [make_step(seq) for seq in range(4, 10)]
    restarted = [make_step(0, incarnation=12), *(make_step(seq, incarnation=12) for seq in range(1, 10))]
    rows = TickRows(Timeline(SPEC))
    assert not has(rows.rows(met_midway), "/env/return")
    assert not has(rows.rows([make_step(seq) for seq in range(10, 15)]), "/env/return")
    assert scalars(rows.rows(restarted), "/env/return") == ([9], [[-11.25]])


def test_no_answer_in_time_is_a_gap_and_misses_are_counted_tick_by_tick() -> None:
    steps = [make_step(1), make_step(2, loop_ns=-1, reaction_ns=-1, missed=True), make_step(3, loop_ns=0)]
    tables = TickRows(Timeline(SPEC)).rows(steps)
    loop = scalars(tables, "/agent/loop_us")[1]
    assert loop[0] == [250.001]
    assert math.isnan(loop[1][0])
    assert loop[2] == [0.0]
    assert math.isnan(scalars(tables, "/agent/reaction_us")[1][1][0])
    assert scalars(tables, "/agent/missed")[1] == [[0.0], [1.0], [0.0]]


def test_each_miss_stands_on_the_series_of_its_cause() -> None:
    causes = ("agent_late", "", "env_late", "agent_late")
    steps = [make_step(k, missed=bool(cause), cause=cause) for k, cause in enumerate(causes)]
    tables = TickRows(Timeline(SPEC)).rows(steps)
    assert scalars(tables, "/agent/missed/agent_late") == ([0, 3], [[1.0], [1.0]])
    assert scalars(tables, "/agent/missed/env_late") == ([2], [[1.0]])
    assert not has(tables, "/agent/missed/transport")


def test_a_tick_without_a_policy_has_no_version() -> None:
    steps = [make_step(0, policy_version=-1), make_step(1, policy_version=0), make_step(2, policy_version=5)]
    assert scalars(TickRows(Timeline(SPEC)).rows(steps), "/agent/policy_version") == ([1, 2], [[0.0], [5.0]])


def test_the_speed_reached_is_distance_over_simulated_time_and_has_gaps_where_it_is_unknown() -> None:
    rows = TickRows(Timeline(SPEC), speed_per_m=2.0)
    at = {0: 5.0, 1: 5.5, 2: 5.25, 4: 9.0, 5: 9.5, 6: 9.5}  # seq 3 is lost; seq 6 is a reset
    steps = [
        make_step(
            seq, episode_tick=0 if seq in (0, 6) else seq, position=np.array([x, 77.0], "<f8").tobytes()
        )
        for seq, x in at.items()
    ]
    first, second = rows.rows(steps[:2]), rows.rows(steps[2:])  # differences go across batches
    values = scalars(first, "/env/drift")[1] + scalars(second, "/env/drift")[1]
    assert [row[0] for row in values] == [1.5] * 6
    np.testing.assert_equal([row[1] for row in values], [math.nan, 1.0, -0.5, math.nan, 1.0, math.nan])


@pytest.mark.parametrize(
    ("drift", "scene", "native_ns", "expected"),
    [
        (DriftConfig(kind="sine", amplitude=0.5), "mujoco", 50 * MS, 60.0),  # k_f / 0.05 s
        (DriftConfig(kind="none", offset=1.0), "mujoco", 50 * MS, None),
        (DriftConfig(kind="sine"), "mujoco", 50 * MS, None),  # no target
        (DriftConfig(kind="ou", sd=0.1), "mujoco", 50 * MS, 60.0),
        (DriftConfig(kind="recorded", path="speeds.csv"), "mujoco", 50 * MS, 60.0),
        (DriftConfig(kind="constant", offset=1.0), "", 50 * MS, None),
        (DriftConfig(kind="constant", offset=1.0), "point", 0, None),
    ],
)
def test_only_a_world_with_a_drifting_target_has_a_speed(
    drift: DriftConfig, scene: str, native_ns: int, expected: float | None
) -> None:
    import msgspec

    spec = msgspec.structs.replace(SPEC, scene=scene, native_period_ns=native_ns)
    assert speed_per_m(spec, EnvConfig(drift=drift, reward=RewardConfig(k_f=3.0))) == expected


def test_phases_come_once_however_often_they_are_told() -> None:
    telemetry = TelemetryRows()
    update, hold = make_notice(0, "update", T0 + 1), make_notice(0, "hold", T0 + 2 * UNIT + 1)
    telemetry.window(update)
    telemetry.stats(make_stats("learner", 0, T0, windows=[update, hold]))
    telemetry.window(hold)
    telemetry.window(update)
    (table,) = telemetry.rows(Timeline(SPEC))
    assert table.entity == "/learner/phase"
    assert table.payload == States(("update", "hold"))
    assert table.index.run_time_ns.tolist() == [1, 2 * UNIT + 1]
    assert telemetry.rows(Timeline(SPEC)) == []


def test_an_operators_hold_is_a_phase_and_a_line() -> None:
    telemetry = TelemetryRows()
    telemetry.window(make_notice(2, "hold", T0 + 5, "operator"))
    telemetry.window(make_notice(2, "update", T0 + 9, "operator"))
    log, phase = telemetry.rows(Timeline(SPEC))
    assert log.payload == Lines(
        ("[operator] holds the policy in window 2", "[operator] resumes the schedule in window 2"),
        ("INFO", "INFO"),
    )
    assert phase.payload == States(("hold", "update"))
    assert log.index.run_time_ns.tolist() == phase.index.run_time_ns.tolist() == [5, 9]


def test_stats_and_events_that_come_twice_count_once() -> None:
    telemetry = TelemetryRows()
    hello, again = (Event(at_ns=T0 + i, level="INFO", text="hello") for i in range(2))
    gauges = {"alpha": 0.5}
    for stats in (
        make_stats("learner", 0, T0, events=[hello], gauges=gauges),
        make_stats("learner", 0, T0, events=[hello], gauges=gauges),  # the same message
        make_stats("learner", 1, T0 + 5, events=[hello, again], gauges=gauges),  # one event repeated, one new
        make_stats("agent_service", 0, T0, events=[hello]),  # the same words from another process
        make_stats("learner", 0, T0 + 9, incarnation=6, gauges=gauges),  # it came back and counts anew
    ):
        telemetry.stats(stats)
    log, alpha = telemetry.rows(Timeline(SPEC))
    assert isinstance(log.payload, Lines)
    assert list(log.payload.texts) == ["[learner] hello", "[learner] hello", "[agent_service] hello"]
    assert log.index.run_time_ns.tolist() == [0, 1, 0]
    assert alpha.index.run_time_ns.tolist() == [0, 5, 9]


def test_only_the_learners_gauges_are_series() -> None:
    telemetry = TelemetryRows()
    telemetry.stats(make_stats("agent_service", 0, T0, gauges={"policy_version": 3.0}))
    telemetry.stats(make_stats("learner", 0, T0 + UNIT, gauges={"loss/critic": 0.5, "q_mean": -2.0}))
    telemetry.stats(make_stats("learner", 1, T0 + 2 * UNIT, gauges={"loss/critic": 0.25, "q_mean": -1.0}))
    tables = telemetry.rows(Timeline(SPEC))
    assert {table.entity for table in tables} == {"/learner/loss/critic", "/learner/q_mean"}
    assert scalars(tables, "/learner/loss/critic") == ([50, 100], [[0.5], [0.25]])


def test_forecast_gauges_share_rows_and_keep_their_columns_when_more_turn_up() -> None:
    telemetry = TelemetryRows()
    telemetry.stats(make_stats("learner", 0, T0, gauges={"forecast/error": 0.5}))
    first = scalars(telemetry.rows(Timeline(SPEC)), "/learner/forecast")[1]
    telemetry.stats(
        make_stats("learner", 1, T0, gauges={"forecast/error": 0.4, "forecast/baseline_error": 0.9})
    )
    telemetry.stats(make_stats("learner", 2, T0, gauges={"forecast/baseline_error": 0.8}))
    second = scalars(telemetry.rows(Timeline(SPEC)), "/learner/forecast")[1]
    assert first == [[0.5]]
    assert telemetry.forecast_names == ["error", "baseline_error"]
    np.testing.assert_equal(second, [[0.4, 0.9], [math.nan, 0.8]])


def test_a_policy_told_twice_is_one_publication() -> None:
    telemetry = TelemetryRows()
    for version in (1, 1, 2):
        telemetry.policy(make_policy(version, T0 + version * UNIT + 3))
    (table,) = telemetry.rows(Timeline(SPEC))
    assert table.index.run_time_ns.tolist() == [UNIT + 3, 2 * UNIT + 3]
    assert scalars([table], "/learner/published_version")[1] == [[1.0], [2.0]]


def test_physics_that_drift_have_a_series_each_and_others_none() -> None:
    steps = [make_step(seq, physics=[1.0 + seq, 0.5, 1.0]) for seq in range(2)]
    assert scalars(TickRows(Timeline(SPEC)).rows(steps), "/env/physics") == (
        [0, 1],
        [[1.0, 0.5, 1.0], [2.0, 0.5, 1.0]],
    )
    assert "/env/physics" not in {rows.entity for rows in TickRows(Timeline(SPEC)).rows([make_step(0)])}
