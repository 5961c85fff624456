"""Environments of a fleet that declare themselves late, twice, or as somebody else."""

from __future__ import annotations

from pathlib import Path

import pytest

from recorder import reading
from recorder.intake import Intake
from tests.recorder.fleet_stage import set_fleet, tick_of, ticks


def test_nobody_waits_for_one_that_has_not_declared_itself_and_it_loses_nothing(tmp_path: Path) -> None:
    fleet = set_fleet(tmp_path)
    stage = fleet.stage
    fleet.send("env0", [tick_of("env0", seq) for seq in range(5)])  # before its own declaration
    fleet.declare("env1")
    fleet.play(range(60), "env1")
    assert stage.ledger.counter("rows") > 0
    fleet.declare("env0")
    fleet.send("env0", [tick_of("env0", seq) for seq in range(5, 60)])
    fleet.play(range(60, 120), "env0", "env1", last=True)
    stage.service.close()
    assert ticks(stage, "env0") == ticks(stage, "env1") == list(range(120))
    assert stage.ledger.counter("dropped") == 0


def test_steps_that_overtake_their_declaration_wait_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    take = Intake.take_specs
    monkeypatch.setattr(
        Intake,
        "take_specs",
        lambda self: {env: spec for env, spec in take(self).items() if env == "env0"},
    )
    fleet = set_fleet(tmp_path)
    fleet.declare("env0", "env1")
    fleet.play(range(100), "env0", "env1")
    monkeypatch.undo()
    fleet.stage.service.flush()
    assert fleet.stage.service._recording is not None
    assert set(fleet.stage.service._recording.file.place.envs) == {"env0"}
    fleet.declare("env1")
    fleet.play(range(100, 110), "env0", "env1", last=True)
    fleet.stage.service.close()
    assert ticks(fleet.stage, "env1") == ticks(fleet.stage, "env0") == list(range(110))


def test_of_two_declarations_before_the_first_look_the_log_follows_the_one_that_is_written_of(
    tmp_path: Path,
) -> None:
    fleet = set_fleet(tmp_path)
    fleet.declare("env1", tick_ns=7)  # a foreign one; then the true one
    fleet.declare("env0", "env1")
    fleet.play(range(20), "env0", "env1", last=True)
    fleet.stage.service.close()
    assert ticks(fleet.stage, "env1") == ticks(fleet.stage, "env0") == list(range(20))


def test_a_second_declaration_changes_nothing(tmp_path: Path) -> None:
    fleet = set_fleet(tmp_path)
    fleet.declare("env0", "env1")
    fleet.play(range(55), "env0", "env1")
    fleet.stage.service.flush()
    fleet.declare("env0", "env1", incarnation=12)  # amid an episode
    fleet.play(range(55, 60), "env0", "env1", last=True)
    fleet.stage.service.close()
    assert reading.columns(fleet.stage.path, "/env0/env/return")[0].tolist() == list(range(9, 60, 10))
