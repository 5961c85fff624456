"""What is in a recording: written by the service in virtual time and read back from the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recorder import reading
from recorder.finish import run_cli
from recorder.reading import Span, TimelineName
from rtcore.messages import Event
from tests.recorder.stage import (
    SPEC,
    T0,
    TICK,
    UNIT,
    WALL_T0,
    Stage,
    make_notice,
    make_policy,
    make_stats,
    make_step,
    run,
    set_stage,
)

TIMELINES: tuple[TimelineName, ...] = ("run_time", "wall", "tick", "episode", "unit")


def times(stage: Stage, entity: str, component: str = reading.SCALARS) -> dict[str, list[int]]:
    return {name: reading.columns(stage.path, entity, component, name)[0].tolist() for name in TIMELINES}


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """120 ticks (2.4 s) with a miss and an overrun, two windows, two policies, an operator, all processes."""
    stage = set_stage(tmp_path_factory.mktemp("told"))
    stage.stats(
        make_stats(
            "learner",
            0,
            T0 - UNIT,
            events=[Event(at_ns=T0 - UNIT, level="INFO", text="learner: core 1, nice 5")],
        )
    )
    stage.spec.put(SPEC)
    steps = [make_step(seq) for seq in range(120)]
    steps[33] = make_step(33, loop_ns=-1, reaction_ns=-1, missed=True, cause="agent_late", fallback="hold")
    steps[61:] = [make_step(seq, tick=seq + 2) for seq in range(61, 120)]  # two deadlines were lost
    stage.window.put(make_notice(0, "update", T0))
    stage.steps(steps[:70])
    stage.policy.put(make_policy(1, T0 + UNIT - 7))
    stage.window.put(make_notice(0, "hold", T0 + UNIT))
    stage.steps(steps[70:])
    stage.policy.put(make_policy(2, T0 + 2 * UNIT + 11))
    stage.window.put(make_notice(1, "update", T0 + 2 * UNIT))
    stage.window.put(make_notice(1, "hold", T0 + 2 * UNIT + 300_000_001, "operator"))
    gauges = {"loss/critic": 0.5, "loss/actor": -1.5, "forecast/error": 0.1, "alpha": 0.2}
    stage.stats(make_stats("learner", 1, T0 + 2 * UNIT + 5, gauges=gauges))
    warning = Event(at_ns=T0 + UNIT + 1, level="WARN", text="late")
    stage.stats(make_stats("agent_service", 0, T0 + UNIT + 2, events=[warning]))
    stage.service.close()
    return stage


def test_every_entity_is_there_and_every_row_stands_on_all_timelines(told: Stage) -> None:
    assert set(reading.entities(told.path)) == {
        "/env/reward", "/env/return", "/env/drift", "/env/pacing_us",
        "/agent/loop_us", "/agent/reaction_us", "/agent/policy_version", "/agent/missed",
        "/agent/missed/agent_late", "/learner/phase", "/learner/published_version",
        "/learner/loss/critic", "/learner/loss/actor", "/learner/forecast", "/learner/alpha",
        "/log", "/run_card",
        "/world/point", "/world/follow", "/world/ground",
    }  # fmt: skip
    for entity in set(reading.entities(told.path)) - {"/run_card", "/world/ground"}:
        assert reading.timelines(told.path, entity) == set(TIMELINES), entity


def test_ticks_stand_at_their_deadlines_exactly(told: Stage) -> None:
    ticks = [*range(61), *range(63, 122)]
    for entity in ("/env/reward", "/env/drift", "/env/pacing_us", "/agent/loop_us", "/agent/missed"):
        assert times(told, entity) == {
            "run_time": [tick * TICK for tick in ticks],
            "wall": [WALL_T0 + tick * TICK for tick in ticks],
            "tick": ticks,
            "episode": [seq // 10 for seq in range(120)],
            "unit": sorted(tick // 50 for tick in ticks),
        }, entity


def test_ticks_have_their_values_exactly(told: Stage) -> None:
    seqs = np.arange(120)
    loop, reaction = (250_000 + seqs) / 1e3, (80_000 + seqs) / 1e3
    loop[33] = reaction[33] = np.nan
    missed = (seqs == 33).astype(float)
    expected = {
        "/env/reward": -0.25 * (seqs % 10),
        "/env/pacing_us": np.full(120, 1.5),
        "/agent/loop_us": loop,
        "/agent/reaction_us": reaction,
        "/agent/missed": missed,
    }
    for entity, values in expected.items():
        np.testing.assert_array_equal(reading.columns(told.path, entity)[1][:, 0], values, entity)
    drift = reading.columns(told.path, "/env/drift")[1]
    np.testing.assert_array_equal(drift[:, 0], 1.5)
    moving = seqs % 10 != 0
    np.testing.assert_allclose(drift[moving, 1], 2.0)  # 0.1 m in 50 ms
    assert np.isnan(drift[~moving, 1]).all()


def test_returns_and_versions_stand_where_they_belong(told: Stage) -> None:
    last = [tick if tick < 61 else tick + 2 for tick in range(9, 120, 10)]
    assert times(told, "/env/return")["tick"] == last
    assert times(told, "/env/return")["episode"] == list(range(12))
    assert reading.columns(told.path, "/env/return")[1].tolist() == [[-11.25]] * 12
    versions = reading.columns(told.path, "/agent/policy_version")[1][:, 0]
    assert versions.tolist() == [seq // 10 for seq in range(120) if seq % 10]


def test_what_is_no_tick_gets_its_place_from_the_time(told: Stage) -> None:
    assert times(told, "/learner/published_version") == {
        "run_time": [UNIT - 7, 2 * UNIT + 11],
        "wall": [WALL_T0 + UNIT - 7, WALL_T0 + 2 * UNIT + 11],
        "tick": [49, 100],
        "episode": [4, 9],  # tick 100 is step 98
        "unit": [0, 2],
    }
    assert reading.columns(told.path, "/learner/published_version")[1].tolist() == [[1.0], [2.0]]
    for name, value in (("loss/critic", 0.5), ("loss/actor", -1.5), ("forecast", 0.1), ("alpha", 0.2)):
        at, values = reading.columns(told.path, f"/learner/{name}", timeline="run_time")
        assert (at.tolist(), values.tolist()) == ([2 * UNIT + 5], [[value]])


def test_phases_are_exact(told: Stage) -> None:
    edge = 2 * UNIT + 300_000_001
    assert reading.spans(told.path) == [
        Span("update", 0, UNIT),
        Span("hold", UNIT, 2 * UNIT),
        Span("update", 2 * UNIT, edge),
        Span("hold", edge, None),
    ]


def test_the_log_has_everybodys_lines_in_order(told: Stage) -> None:
    at, texts = reading.texts(told.path, "/log")
    assert at.tolist() == [-UNIT, UNIT + 1, 2 * UNIT + 300_000_001]
    assert texts == [
        "[learner] core 1, nice 5",
        "[agent_service] late",
        "[operator] holds the policy in window 1",
    ]
    assert reading.texts(told.path, "/log", reading.LEVEL)[1] == ["INFO", "WARN", "INFO"]


def test_the_run_card_says_what_this_is(told: Stage) -> None:
    card = reading.document(told.path)
    for words in (
        "# r1", "`pointmass`", "| seed | 3 |", "50 Hz, so a deadline every 20 ms; 2.5 x native speed",
        "constant 1.5", "fixed: windows of 10 units, 0.7 (floor)", "`sac`", "| learner | core 1, nice 5 |",
    ):  # fmt: skip
        assert words in card


def test_the_point_is_drawn_where_it_is(told: Stage) -> None:
    ticks, places = reading.columns(told.path, "/world/point", reading.TRANSLATION)
    assert len(ticks) == 120  # 50 Hz: every tick
    np.testing.assert_allclose(places[:10, 0], 0.1 * np.arange(10), rtol=1e-6)
    assert not places[:, 1:].any()


def test_the_file_is_compact_verified_and_has_one_dashboard(told: Stage) -> None:
    import rerun.chunk as rc

    assert "verified" in run_cli(["rrd", "verify", str(told.path)], timeout_s=10)
    assert len(rc.RrdReader(str(told.path)).blueprints()) == 1
    assert (
        len([1 for chunk in rc.RrdReader(str(told.path)).stream() if chunk.entity_path == "/env/reward"]) <= 2
    )
    assert sorted(path.name for path in told.path.parent.iterdir()) == [
        "learner",
        "logs",
        "recording.rrd",
        "run.toml",
    ]


def test_the_books_are_right(told: Stage) -> None:
    ticks = 6 * 120 + 2 * 120 + (120 - 12) + 12 + 1  # six series, point and frame, versions, returns, a cause
    others = 2 + 4 + 3 + 4  # publications, phases, lines, gauges
    assert told.ledger.stats(0).counters == {
        "rows": ticks + others,
        "dropped": 0,
        "disk_dropped": 0,
        "live_dropped": 0,
    }


def test_light_detail_leaves_3d_out(tmp_path: Path) -> None:
    stage = set_stage(tmp_path, detail="light")
    run(stage, [make_step(seq) for seq in range(60)])
    assert "/env/reward" in reading.entities(stage.path)
    assert not [entity for entity in reading.entities(stage.path) if entity.startswith("/world")]


def test_a_position_that_does_not_fit_is_not_drawn(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    odd = [make_step(3, position=b"123"), make_step(4, position=b""), make_step(5, position=bytes(8 * 4))]
    run(stage, [*(make_step(seq) for seq in range(3)), *odd])
    assert reading.columns(stage.path, "/world/point", reading.TRANSLATION)[0].tolist() == [0, 1, 2]
    assert len(reading.columns(stage.path, "/env/reward")[0]) == 6
