"""The service in virtual time: when it writes, what it makes of disorder, loss and restarts, how it ends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import recorder.service
from recorder import reading
from recorder.finish import FinishError, run_cli
from rtcore.messages import Event, Step, StepBatch
from tests.recorder.stage import (
    CONFIG,
    MS,
    SPEC,
    T0,
    TICK,
    UNIT,
    come_back,
    drain,
    make_stats,
    make_step,
    run,
    set_stage,
)


def _batch(*steps: Step) -> StepBatch:
    return StepBatch(steps=list(steps))


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
    second = come_back(first)
    second.steps([make_step(seq) for seq in range(80)], size=80, last=True)  # it gets the whole log again
    second.service.close()
    assert reading.columns(second.path, "/env/reward")[0].tolist() == list(range(80))
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
    assert event.text == (
        "the recording has all rows but stays as it was written: rerun rrd optimize took over 1.5 s; "
        f"to complete it: python -m recorder.finish {stage.path}"
    )
    assert reading.columns(stage.path, "/env/reward")[0].tolist() == list(range(60))
    run_cli(["rrd", "verify", "--check-footers=false", str(stage.path)], timeout_s=10)


def test_if_not_even_one_file_can_be_made_it_is_told_of_how_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(recording: Path, *, timeout_s: float) -> None:
        raise FinishError("no space")

    monkeypatch.setattr(recorder.service, "finish", fail)
    stage = set_stage(tmp_path)
    stage.spec.put(SPEC)
    for begin in (0, 60, 120):
        stage.steps([make_step(seq) for seq in range(begin, begin + 60)])
        stage.service.flush()  # and then it dies
        stage = come_back(stage)
    stage.steps([make_step(seq) for seq in range(180, 200)], last=True)
    stage.service.close()
    text = stage.events()[-1].text
    assert text.startswith("the recording has all rows but is in 4 files: no space; to complete it: ")


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
    assert drain(stage) == pytest.approx(waited_s * 1e9, abs=50 * MS)


def test_closing_twice_does_nothing(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    run(stage, [make_step(seq) for seq in range(10)])
    before = stage.path.read_bytes()
    stage.service.close()
    assert stage.path.read_bytes() == before
