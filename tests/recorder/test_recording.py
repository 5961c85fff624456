"""A whole recording, written by the service in virtual time and read back from the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import recorder.service
from recorder import reading
from recorder.finish import FinishError, run_cli
from recorder.reading import Span, TimelineName
from recorder.service import RecorderService
from rtcore import channels
from rtcore.lifecycle import Stop
from rtcore.messages import Event, Step, StepBatch
from tests.recorder.stage import (
    CONFIG,
    MS,
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
    set_stage,
)

TIMELINES: tuple[TimelineName, ...] = ("run_time", "wall", "tick", "episode", "unit")


def run(stage: Stage, steps: list[Step]) -> None:
    stage.spec.put(SPEC)
    stage.steps(steps, last=True)
    stage.service.close()


def times(stage: Stage, entity: str, component: str = reading.SCALARS) -> dict[str, list[int]]:
    return {name: reading.columns(stage.path, entity, component, name)[0].tolist() for name in TIMELINES}


def _batch(*steps: Step) -> StepBatch:
    return StepBatch(steps=list(steps))


def _service(stage: Stage) -> RecorderService:
    """Another incarnation of the stage's recorder."""
    bus = stage.hub.bus(channels.RECORDER, stage.clock)
    return RecorderService(stage.config, stage.run_dir, bus, stage.clock, stage.ledger)


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
        "/learner/phase", "/learner/published_version", "/learner/loss/critic", "/learner/loss/actor",
        "/learner/forecast", "/learner/alpha", "/log", "/run_card",
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
    ticks = 6 * 120 + 2 * 120 + (120 - 12) + 12  # six series, the point and its frame, versions, returns
    others = 2 + 4 + 3 + 4  # publications, phases, lines, gauges
    assert told.ledger.stats(0).counters == {"rows": ticks + others, "dropped": 0, "live_dropped": 0}


def test_rows_wait_for_company_for_half_a_second_to_a_second(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    stage.spec.put(SPEC)
    rows = []
    for seq in range(120):
        stage.steps([make_step(seq)])
        rows.append(stage.ledger.counter("rows"))
    written_at = [seq for seq in range(1, 120) if rows[seq] != rows[seq - 1]]
    assert written_at == [49, 99]  # 50 steps each, 0.98 s: enough rows, not yet a second
    fast = set_stage(tmp_path / "fast")
    fast.spec.put(SPEC)
    for seq in range(200):  # 1 ms apart: 50 steps are there after 50 ms, but are not half a second old
        fast.clock.sleep_until_ns(T0 + seq * MS)
        fast.log.put(_batch(make_step(seq, due_ns=T0 + seq * MS)))
        fast.service.poll()
    assert fast.ledger.counter("rows") == 0
    fast.clock.sleep_until_ns(T0 + 500 * MS)
    fast.service.poll()
    assert fast.ledger.counter("rows") > 0


def test_a_lone_line_is_written_within_a_second(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    stage.spec.put(SPEC)
    stage.service.poll()
    stage.stats(make_stats("learner", 0, T0, events=[Event(at_ns=T0, level="INFO", text="x")]))
    stage.service.poll()
    assert stage.ledger.counter("rows") == 0
    stage.clock.advance_ns(UNIT)
    stage.service.poll()
    assert stage.ledger.counter("rows") == 1


def test_steps_that_come_twice_or_in_disorder_are_written_once_in_order(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    stage.spec.put(SPEC)
    steps = [make_step(seq) for seq in range(40)]
    for part in (steps[:10], steps[20:30], steps[5:15], steps[15:25], steps[30:]):
        stage.log.put(_batch(*part))
        stage.service.poll()
    stage.service.close()
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == list(range(40))
    assert stage.ledger.counter("dropped") == 0


def test_a_lost_batch_is_waited_for_then_counted_and_told(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    stage.spec.put(SPEC)
    stage.steps([make_step(seq) for seq in range(20)], size=20)
    stage.steps([make_step(seq) for seq in range(25, 50)], size=25)
    stage.clock.advance_ns(4 * UNIT)
    stage.service.poll()
    assert stage.ledger.counter("dropped") == 0
    stage.clock.advance_ns(2 * UNIT)
    stage.service.poll()
    stage.service.flush()
    assert stage.ledger.counter("dropped") == 5
    (event,) = stage.events()
    assert (event.level, event.text) == (
        "WARN",
        "5 steps never came: their ticks are missing from the recording",
    )
    stage.service.close()
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == [*range(20), *range(25, 50)]
    assert reading.columns(stage.path, "/env/return")[0].tolist() == [9, 19, 39, 49]


def test_a_full_queue_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recorder.intake.STATS_CAPACITY", 3)
    monkeypatch.setattr("recorder.intake.LOG_CAPACITY", 2)
    stage = set_stage(tmp_path)
    stage.spec.put(SPEC)
    for seq in range(5):
        stage.stats(make_stats("learner", seq, T0))  # 2 too many
    for seq in range(0, 40, 10):
        stage.log.put(_batch(*(make_step(seq + i) for i in range(10))))  # the first 20 steps go
    stage.service.close()
    assert stage.ledger.counter("dropped") == 2 + 20


def test_steps_from_before_the_declaration_are_kept(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    stage.steps([make_step(seq) for seq in range(30)])
    run(stage, [make_step(seq) for seq in range(30, 60)])
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == list(range(60))


def test_nobody_there_leaves_an_empty_but_sound_file(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    stage.stats(make_stats("learner", 0, T0, events=[Event(at_ns=T0, level="INFO", text="x")]))
    stage.service.poll()
    stage.service.close()
    assert [event.text for event in stage.events()] == [
        "no env server ever declared itself: the recording is empty"
    ]
    assert reading.entities(stage.path) == []
    run_cli(["rrd", "verify", str(stage.path)], timeout_s=10)


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


def test_an_env_server_that_comes_back_goes_on_on_the_same_timeline(tmp_path: Path) -> None:
    import msgspec

    stage = set_stage(tmp_path)
    stage.spec.put(SPEC)
    stage.steps([make_step(seq) for seq in range(20)])
    later = msgspec.structs.replace(SPEC, incarnation=12, t0_ns=T0 + 2 * UNIT)
    stage.spec.put(later)
    stage.steps(
        [make_step(seq, incarnation=12, due_ns=T0 + 2 * UNIT + seq * TICK) for seq in range(10)], last=True
    )
    stage.service.close()
    at = reading.columns(stage.path, "/env/reward", timeline="run_time")[0]
    assert at.tolist() == [*(seq * TICK for seq in range(20)), *(2 * UNIT + seq * TICK for seq in range(10))]
    assert stage.ledger.counter("dropped") == 0


def test_a_recorder_that_comes_back_keeps_what_was_recorded_before(tmp_path: Path) -> None:
    first = set_stage(tmp_path)
    first.spec.put(SPEC)
    first.steps([make_step(seq) for seq in range(60)])
    first.service.flush()  # and then it dies: no footer
    written = first.ledger.counter("rows")
    second = Stage(first.run_dir, first.config, first.clock, first.ledger, _service(first), first.hub)
    second.steps([make_step(seq) for seq in range(60, 80)], last=True)
    second.service.close()
    ticks = reading.columns(second.path, "/env/reward")[0].tolist()
    assert sorted(set(ticks)) == list(range(80))
    assert written > 0
    assert "goes on with a recording; what there was is in recording.part000.rrd until the end" in [
        event.text for event in second.events()
    ]
    assert not list(second.path.parent.glob("*part*"))


def test_if_finishing_fails_the_raw_file_stays_and_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(recording: Path, *, timeout_s: float) -> None:
        raise FinishError("rerun rrd optimize took over 1.5 s")

    monkeypatch.setattr(recorder.service, "finish", fail)
    stage = set_stage(tmp_path)
    run(stage, [make_step(seq) for seq in range(60)])
    (event,) = stage.events()
    assert event.level == "WARN"
    assert event.text.endswith("stays as it was written: rerun rrd optimize took over 1.5 s")
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == list(range(60))
    run_cli(["rrd", "verify", str(stage.path)], timeout_s=10)


@pytest.mark.parametrize(("ticks", "patience"), [(60, 1.5), (100, 10.0)])
def test_who_interrupts_waits_less_for_compaction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ticks: int, patience: float
) -> None:
    given: list[float] = []
    monkeypatch.setattr(recorder.service, "finish", lambda path, *, timeout_s: given.append(timeout_s))
    stage = set_stage(tmp_path, config=replace(CONFIG, duration_s=2.5))
    run(stage, [make_step(seq) for seq in range(ticks)])
    assert given == [patience]


@pytest.mark.parametrize(
    ("last", "final", "waited_s"), [(True, True, 0.0), (True, False, 2.0), (False, True, 2.0)]
)
def test_after_the_stop_it_waits_for_last_words_up_to_two_seconds(
    tmp_path: Path, last: bool, final: bool, waited_s: float
) -> None:
    stage = set_stage(tmp_path)
    stage.spec.put(SPEC)
    stage.stats(make_stats("learner", 0, T0))
    stage.stats(make_stats("recorder", 0, T0))  # its own last words cannot be waited for
    stage.steps([make_step(seq) for seq in range(10)], last=last)
    if final:
        stage.stats(make_stats("learner", 1, T0, final=True))
        stage.service.poll()
    stop = Stop()
    stop.set("test")
    begin_ns = stage.clock.now_ns()
    stage.service.run(stop)
    assert stage.clock.now_ns() - begin_ns == pytest.approx(waited_s * 1e9, abs=50 * MS)


def test_closing_twice_does_nothing(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    run(stage, [make_step(seq) for seq in range(10)])
    before = stage.path.read_bytes()
    stage.service.close()
    assert stage.path.read_bytes() == before
