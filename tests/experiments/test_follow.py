"""The experiment on a schedule that follows: its world, its reading of runs, its numbers by hand."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from env_server.worlds.recorded import read_series
from experiments.follow import Arguments, by_part, main, reaction, repeat, sum_up
from experiments.follow_runs import (
    ARMS,
    PERIOD,
    Course,
    Lived,
    carry_out,
    command,
    explained,
    read_chosen,
    read_lived,
    read_summary,
    without,
)
from launcher.options import RunOptions, read
from recorder.reading import texts


@pytest.mark.parametrize("part", [40, 100, 300])
def test_the_world_stands_still_drifts_and_stands_still_without_a_jump(part: int) -> None:
    values, fastest = Course(part).drift(), 2 * math.pi / PERIOD
    assert values.shape == (3 * part,)
    for still in (values[: part + 1], values[2 * part :]):
        np.testing.assert_array_equal(still, values[0])
    assert np.abs(np.diff(values)).max() <= fastest
    middle = values[part : 2 * part]
    np.testing.assert_allclose(
        middle[:-2] + middle[2:], 2 * math.cos(fastest) * middle[1:-1], atol=1e-12
    )  # of any sine


def test_a_minute_is_nearly_two_periods_and_swings_both_ways() -> None:
    """phase = (pi - 300 omega) / 2 = pi / 2 - 15 pi / 8, and its sine is that of 5 pi / 8."""
    values = Course(300).drift()
    assert values[0] == pytest.approx(math.sin(5 * math.pi / 8))
    assert values.min() < -0.99 and values.max() > 0.99
    assert Course(300).seconds == pytest.approx(180) and Course(300).windows == 15


def test_the_file_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    Course(40).write(tmp_path / "drift.csv")
    units, values = read_series(str(tmp_path / "drift.csv"))
    np.testing.assert_array_equal(units, range(120))
    np.testing.assert_array_equal(values, Course(40).drift())


@pytest.mark.parametrize("arm", ARMS)
def test_every_arm_is_the_preset_but_for_its_schedule(arm: str, tmp_path: Path) -> None:
    Course(40).write(tmp_path / "drift.csv")
    argv = command("sim", arm, tmp_path / "drift.csv", Course(40), 3, tmp_path / "run", ())[4:]
    config, _ = read(RunOptions, argv, prog="", description="")
    table = config.learner.table
    assert (config.learner.algo, config.learner.gamma, config.learner.forecast.l_p) == ("npg", 0.9, 20)
    assert (table.step_size, table.epsilon, table.eta, table.entropy) == (0.3, 0.5, 0.2, 0.1)
    assert (config.env.hz, config.env.unit_s, config.env.mdp.states, config.seed) == (200, 0.2, 5, 3)
    assert config.duration_s == pytest.approx(24)
    schedule = config.learner.schedule
    assert schedule.l_f == 20
    if arm.startswith("G = "):
        assert round(schedule.gamma_f * 20, 9) == int(arm.removeprefix("G = "))


def test_random_actions_are_taken_out_again() -> None:
    policy = np.array([[1.0, 0.0], [0.3, 0.7]])
    mixed = (0.5 * policy + 0.25).astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(without(mixed, 0.5), policy, atol=1e-6)


def test_parts_by_hand() -> None:
    """Two numbers a second: 1 .. 4, 10 .. 40, 5; their later halves 3, 4 and 30, 40."""
    values = np.array([[1, 2, 3, 4, 10, 20, 30, 40, 5, 5, 5, 5]], float)
    np.testing.assert_allclose(by_part(values), np.array([[[2.5, 3.5], [25, 35], [5, 5]]]))


@pytest.mark.parametrize(
    ("hold", "expected"),
    [
        ([9, 9, 9, 0, 0, 4, 0, 0, 0], (3, 0)),
        ([0, 0, 0, 1, 0, 0, 2, 3, 0], (1, 2)),
        ([0, 0, 0, 0, 0, 0, 0, 0, 7], (4, 3)),
    ],
)
def test_reactions_by_hand(hold: list[int], expected: tuple[int, int]) -> None:
    assert reaction(np.array(hold), 3) == expected


def test_sums_by_hand() -> None:
    """Two seeds, two windows a part; regret 1 and 3 with auto, 2 and 3 without a hold: paired -1 and 0."""

    def lived(hold: list[int], regret: float) -> Lived:
        return Lived(hold, np.full(120, regret), np.full(120, regret / 10))

    found = sum_up(
        {
            "auto": [lived([4, 0, 8, 0, 2, 0], 1.0), lived([0, 0, 4, 2, 0, 0], 3.0)],
            "no hold": [lived([0] * 6, 2.0), lived([0] * 6, 3.0)],
        },
        Course(40),
    )
    assert found["hold"]["drifting"]["whole"][0] == 3.5 and found["hold"]["drifting"]["settled"][0] == 1
    assert found["share_of_windows_with_a_hold"]["drifting"]["whole"][0] == 0.75
    assert found["windows_to_the_first_hold"] == [1, 1] and found["windows_to_the_last_hold"] == [1, 0]
    # Student's quantile of one degree is 12.706, the standard error of -1 and 0 is 1 / 2
    less = found["regret_per_unit"]["auto - no hold"]["still"]["whole"]
    assert less == pytest.approx([-0.5, 6.3531], abs=1e-4)
    assert found["regret_per_unit_without_random_actions"]["auto"]["still"]["whole"][0] == pytest.approx(0.2)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six windows in virtual time, recorded."""
    root = tmp_path_factory.mktemp("follow")
    Course(40).write(root / "drift.csv")
    carry_out(command("sim", "auto", root / "drift.csv", Course(40), 0, root / "run", ["--record"]))
    return root / "run"


def test_the_timeline_says_what_was_chosen_and_why(run: Path) -> None:
    chosen = read_chosen(run, Course(40))
    assert [one.m for one in chosen] == list(range(6))
    assert [(one.update, one.hold) for one in chosen] == [
        (w["G"], w["N"]) for w in read_summary(run)["windows"]
    ]
    assert "as declared" in chosen[0].why and math.isnan(chosen[0].predicted)  # nothing is known yet
    for one in chosen[1:]:
        assert 0 <= one.trust <= 1 and one.predicted <= one.unheld
    assert [math.isnan(one.realised) for one in chosen] == [False] * 5 + [True]


def test_a_recording_that_disagrees_is_found(run: Path) -> None:
    with pytest.raises(AssertionError):
        read_chosen(run, Course(60))


def test_a_line_of_the_log_is_read_whole(run: Path) -> None:
    recording = run / "recording.rrd"
    said = explained(recording)
    assert [f"[learner] window {m}: {text}" for m, text in said.items()] == [
        line for line in texts(recording, "/log")[1] if line.startswith("[learner] window ")
    ]


def test_its_regret_is_that_of_the_summary(run: Path) -> None:
    lived, summary = read_lived(run, Course(40)), read_summary(run)
    assert lived.regret.sum() == pytest.approx(summary["regret"]["total"])
    assert (lived.learned[20:] < lived.regret[20:]).all()  # half of the actions are random


def test_a_failing_run_is_told() -> None:
    with pytest.raises(RuntimeError, match=r"exit code 2\n.*preset = 'nowhere'"):
        carry_out([*command("sim", "auto", Path("none.csv"), Course(40), 0, Path("run"), ())[:4], "nowhere"])


def test_what_is_written(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recorded run is the one above; what comes of the others is made up."""

    def carried_out(arguments: list[str]) -> None:
        drift, home = (
            Path(arguments[arguments.index(name) + 1]) for name in ("--env.drift.path", "--run-dir")
        )
        assert arguments == command("sim", "auto", drift, Course(40), 0, home, ["--record"])
        assert drift.read_bytes() == (run.parent / "drift.csv").read_bytes()
        shutil.copytree(run, home)

    monkeypatch.setattr("experiments.follow.carry_out", carried_out)
    lived = [Lived([0, 9] * 3, np.full(120, value), np.zeros(120)) for value in (1.0, 2.0)]
    monkeypatch.setattr("experiments.follow.repeat", lambda *_: {"auto": lived, "live": lived[::-1]})
    picture = tmp_path / "docs" / "follow.png"
    main(Arguments(seeds=2, live=False, part_s=8.0, out=tmp_path, picture=picture))
    (path,) = tmp_path.glob("*-follow.json")
    found = json.loads(path.read_text())
    assert found["recorded"]["clock"] == "virtual" and len(found["recorded"]["chosen"]) == 6
    assert found["recorded"]["chosen"][0]["predicted"] is None
    assert set(found["regret_per_unit"]) == {"auto", "live", "auto - live"}
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_every_arm_is_lived_with_every_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr("experiments.follow.carry_out", lambda arguments: asked.append(" ".join(arguments)))
    monkeypatch.setattr("experiments.follow.read_lived", lambda run, course: Lived([], run.name, course))
    found = repeat(
        Arguments(seeds=2, more="--learner.table.eta 0.5"), Path("drift.csv"), Course(40), tmp_path
    )
    names = {name: [str(one.regret) for one in lived] for name, lived in found.items()}
    assert names == {name: [f"{name}-0", f"{name}-1"] for name in ARMS}
    assert len(asked) == 2 * len(ARMS)
    assert all(line.endswith("--no-record --learner.table.eta 0.5") for line in asked)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [(Arguments(seeds=1), "seeds = 1"), (Arguments(part_s=5.0), "part_s = 5.0")],
)
def test_wrong_arguments_are_refused(arguments: Arguments, told: str) -> None:
    with pytest.raises(SystemExit, match=told):
        main(arguments)
