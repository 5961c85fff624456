"""Schedules at work in the learner's service, in virtual time: chosen, explained, changed, outlived."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtcore.config import ForecastConfig, ScheduleConfig
from rtcore.messages import Command, CommandReply
from rtcore.run_dir import RunDir
from tests.learner.tabular.test_table_service import CONFIG, TICKS, Rig

AUTO = ScheduleConfig(kind="auto", l_f=4, gamma_f=0.5)
STUDENT = replace(CONFIG.learner, algo="npg", schedule=AUTO, forecast=ForecastConfig(l_p=3))
RUN = replace(CONFIG, learner=STUDENT)


@pytest.fixture
def run_dir(tmp_path: Path) -> RunDir:
    return RunDir.create(tmp_path / "run", RUN)


def start(run_dir: RunDir, **learner: object) -> Rig:
    fields: dict[str, Any] = {"schedule": AUTO, "forecast": STUDENT.forecast} | learner
    return Rig(run_dir, "npg", **fields)


def windows(rig: Rig) -> dict[int, tuple[int, int, int | None]]:
    notices = rig.ledger.stats(0, final=True).windows
    return {one.window: (one.start_unit, one.update_units, one.hold_units) for one in notices}


def events(rig: Rig) -> list[str]:
    return [event.text for event in rig.ledger.stats(0).events]


def schedule(rig: Rig, **fields: object) -> CommandReply:
    wanted = replace(AUTO, **fields)  # type: ignore[arg-type]
    return rig.learner.command(Command(id="s", verb="schedule", schedule=wanted))


def test_it_falls_back_and_then_chooses_and_says_why(run_dir: RunDir) -> None:
    rig = start(run_dir)
    rig.live(0, 12 * TICKS - 1)
    assert windows(rig)[0] == (0, 2, 2)
    said = [text for text in events(rig) if text.startswith("window ")]
    declared = "2 units of update, 2 of hold: as declared, for 0 of 3 past Q functions are there"
    assert said[0] == f"window 0: {declared}"
    assert len(said) == 3
    assert all("predicted" in text or "noise" in text for text in said[1:])
    gauges = rig.ledger.stats(0).gauges
    assert (gauges["schedule/update"], gauges["schedule/hold"]) == windows(rig)[2][1:]
    assert gauges["schedule/predicted"] <= gauges["schedule/unheld"]
    assert gauges["schedule/realised"] > 0


def test_what_it_announces_is_what_it_does(run_dir: RunDir) -> None:
    rig = start(run_dir)
    rig.live(0, 40 * TICKS - 1)
    made = windows(rig)
    assert sorted(made) == list(range(10))
    assert all(update + hold == 4 for _, update, hold in made.values() if hold is not None)
    published = [(policy.window, policy.iterate) for policy in rig.published()]
    assert published == [(m, g) for m, (_, update, _) in made.items() for g in range(1, update + 1)]
    assert rig.ledger.counter("published_in_hold") == 0


def test_live_makes_a_forecast_and_an_iterate_in_every_unit(run_dir: RunDir) -> None:
    rig = start(run_dir, schedule=ScheduleConfig(kind="live", l_f=4, gamma_f=0.5))
    rig.live(0, 6 * TICKS - 1)
    assert windows(rig) == {m: (m, 1, 0) for m in range(6)}
    assert [(policy.window, policy.iterate) for policy in rig.published()] == [(m, 1) for m in range(6)]
    assert rig.ledger.stats(0).gauges["forecast/horizon"] == 1.0


def test_an_operator_changes_the_schedule_at_the_window_s_end(run_dir: RunDir) -> None:
    rig = start(run_dir, schedule=ScheduleConfig(l_f=4, gamma_f=0.5))
    rig.live(0, TICKS)
    assert schedule(rig, kind="fixed", l_f=3, gamma_f=1.0).text == (
        "the schedule will change when the present window has ended"
    )
    rig.live(TICKS + 1, 10 * TICKS - 1)
    assert windows(rig) == {0: (0, 2, 2), 1: (4, 3, 0), 2: (7, 3, 0)}
    assert "operator: schedule fixed from unit 4 on" in events(rig)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"l_f": 0}, "learner.schedule.l_f = 0: must be an integer in 1..1000000000"),
        ({"kind": "explicit"}, "learner.schedule.t_m = (): must list at least one window start"),
        (
            {"least_update": 5},
            "learner.schedule.least_update = 5: must be <= learner.schedule.l_f, which is 4",
        ),
    ],
)
def test_a_wrong_schedule_is_refused_and_nothing_changes(
    run_dir: RunDir, fields: dict[str, object], message: str
) -> None:
    rig = start(run_dir, schedule=ScheduleConfig(l_f=4, gamma_f=0.5))
    rig.live(0, TICKS)
    assert (schedule(rig, **fields).ok, schedule(rig, **fields).text) == (False, message)
    rig.live(TICKS + 1, 6 * TICKS)
    assert windows(rig) == {0: (0, 2, 2), 1: (4, 2, 2)}


def test_an_order_without_a_schedule_is_refused(run_dir: RunDir) -> None:
    rig = start(run_dir)
    reply = rig.learner.command(Command(id="s", verb="schedule"))
    assert (reply.ok, reply.text) == (False, "schedule = None: must be given")


def test_a_second_learner_goes_on_by_what_was_chosen_and_ordered(run_dir: RunDir) -> None:
    first = start(run_dir)
    first.live(0, TICKS)
    schedule(first, kind="auto", l_f=6, least_update=4)
    first.live(TICKS + 1, 13 * TICKS + 2)
    chosen = windows(first)[2]
    assert chosen[0] == 10
    first.learner.close()
    first.learner.outbox.flush()
    second = start(run_dir)
    second.live(13 * TICKS + 3, 18 * TICKS)
    assert windows(second)[2] == chosen
    assert windows(second)[3][0] == 16
    assert windows(second)[3][1] >= 4


def test_a_damaged_timetable_is_said_and_windows_are_as_configured(run_dir: RunDir) -> None:
    (run_dir.learner_dir / "schedule.json").write_bytes(b"{")
    rig = start(run_dir, schedule=ScheduleConfig(l_f=4, gamma_f=0.5))
    rig.live(0, TICKS)
    assert windows(rig) == {0: (0, 2, 2)}
    assert any("timetable on disk is damaged" in text for text in events(rig))


def test_what_was_chosen_is_not_chosen_again(run_dir: RunDir) -> None:
    first = start(run_dir)
    first.live(0, 13 * TICKS)
    first.learner.close()
    first.learner.outbox.flush()
    kept = run_dir.learner_dir / "schedule.json"
    sections = json.loads(kept.read_text())
    (m, update), others = sections[0]["chosen"][-1], range(1, 5)
    other = next(number for number in others if number != update)
    sections[0]["chosen"][-1] = [m, other]
    kept.write_text(json.dumps(sections))
    second = start(run_dir)
    second.live(13 * TICKS + 1, 14 * TICKS)
    assert windows(second)[m] == (12, other, 4 - other)


def test_windows_that_are_numbered_anew_are_improved_in_all_the_same(run_dir: RunDir) -> None:
    """After 12 windows of one unit, the timetable lost: windows of 4 units, of which the fourth begins."""
    first = start(run_dir, schedule=ScheduleConfig(kind="live"))
    first.live(0, 12 * TICKS - 1)
    assert max(windows(first)) == 11
    first.learner.close()
    first.learner.outbox.flush()
    second = start(run_dir, schedule=ScheduleConfig(l_f=4, gamma_f=0.5))
    second.live(12 * TICKS, 16 * TICKS - 1)
    assert windows(second) == {3: (12, 2, 2)}
    assert [(policy.window, policy.iterate) for policy in second.published()][-2:] == [(3, 1), (3, 2)]


def test_another_schedule_than_the_one_that_was_kept_is_said(run_dir: RunDir) -> None:
    first = start(run_dir)
    first.live(0, 6 * TICKS)
    first.learner.close()
    first.learner.outbox.flush()
    second = start(run_dir, schedule=ScheduleConfig(l_f=3, gamma_f=1.0))
    second.live(6 * TICKS + 1, 9 * TICKS)
    assert windows(second)[2][0] == 8
    assert any("not as configured now" in text for text in events(second))


@pytest.mark.parametrize(("unit", "told"), [(2, (0, 3, 0)), (7, (0, 5, 3))])
def test_a_window_that_an_order_ends_is_told_as_it_was(
    run_dir: RunDir, unit: int, told: tuple[int, int, int]
) -> None:
    rig = start(run_dir, schedule=ScheduleConfig(kind="explicit", t_m=(0,), g_m=(5,)))
    rig.live(0, unit * TICKS + 3)
    assert windows(rig)[0] == (0, 5, None)
    schedule(rig, kind="fixed", l_f=4, gamma_f=0.5)
    rig.live(unit * TICKS + 4, unit * TICKS + 7)
    assert windows(rig) == {0: told}
    gauges = rig.ledger.stats(0).gauges
    assert (gauges["schedule/update"], gauges["schedule/hold"]) == told[1:]
    rig.live(unit * TICKS + 8, (unit + 2) * TICKS)
    assert windows(rig)[1] == (unit + 1, 2, 2)
