"""Every mistake is one line that names the field, its value and what is allowed; nothing is left behind."""

from __future__ import annotations

import os
import subprocess
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from launcher.cli import COMMANDS, Command, run_command
from tests.launcher.commands import tenuto, tree

BAD_TOML = "[env]\nhz = = 3\n"
UNKNOWN_KEY = "[env]\nherz = 100.0\n"
OVERLAP = '[learner.schedule]\nkind = "explicit"\nt_m = [0, 5]\ng_m = [6, 2]\n'
WRONG_RANGE = "[learner.schedule]\ngamma_f = 2.0\n"

PLAIN_PENDULUM = '[env]\nid = "Pendulum-v1"\ndrift.kind = "none"\n'

# The ones that people make most are tried on the real command.
TYPED = {
    "preset": (["run", "cheetah"], ["preset", "'cheetah'", "halfcheetah, "]),
    "env_id": (["run", "gym", "--env.id", "Nowhere-v5"], ["env.id", "'Nowhere-v5'"]),
    "discrete_actions": (["run", "gym", "--env.id", "CartPole-v1"], ["env.id", "'CartPole-v1'"]),
    "gamma_f_0": (["run", "--learner.schedule.gamma-f", "0"], ["learner.schedule.gamma_f", "0.0", "(0, 1]"]),
    "gamma_f_above_1": (["run", "--learner.schedule.gamma-f", "1.5"], ["gamma_f", "1.5", "(0, 1]"]),
    "l_f": (["run", "--learner.schedule.l-f", "0"], ["learner.schedule.l_f", "0", "integer in 1.."]),
    "hz": (["run", "--env.hz", "-1"], ["env.hz", "-1.0", "must be in"]),
    "period": (["run", "--env.hz", "30", "--env.speed", "1.7"], ["env.speed", "1.7", "multiple", "0.01 s"]),
    "run_dir_below_a_file": (["run", "--run-dir", "file/run"], ["run_dir", "file/run", "must be a path"]),
    "run_dir_unwritable": (["run", "--run-dir", "/proc/run"], ["run_dir", "'/proc/run'", "must be a path"]),
    "run_dir_exists": (["run", "--run-dir", "taken"], ["run_dir", "taken", "must not exist yet"]),
    "overlap": (
        ["run", "--config", "overlap.toml"],
        ["learner.schedule", "6"],
    ),
    "config_missing": (["run", "--config", "none.toml"], ["config", "'none.toml'", "readable"]),
    "a_network_for_a_table": (
        ["run", "cliffworld", "--learner.algo", "sac"],
        ["learner.algo", "'sac'", "q, fq, npg", "cliffworld"],
    ),
    "a_table_for_a_network": (
        ["run", "pointmass", "--learner.algo", "q"],
        ["learner.algo", "'q'", "sac, fsac, rsac", "pointmass"],
    ),
}
OTHERS = {
    "command": (["rum"], ["command", "'rum'", "run, sim"]),
    "preset_and_config": (["run", "gym", "--config", "good.toml"], ["config", "good.toml", "'gym'"]),
    "config_is_a_directory": (["run", "--config", "taken"], ["config", "'taken'", "readable"]),
    "config_no_toml": (["run", "--config", "bad.toml"], ["config", "'bad.toml'", "TOML"]),
    "config_unknown_key": (["run", "--config", "key.toml"], ["env.herz", "100.0", "hz"]),
    "config_range": (["run", "--config", "range.toml"], ["gamma_f", "2.0", "(0, 1]"]),
    "unknown_flag": (["run", "--env.herz", "3"], ["argument", "'--env.herz'", "--help"]),
    "second_positional": (["run", "gym", "swimmer"], ["argument", "'swimmer'"]),
    "no_number": (["run", "--env.hz", "fast"], ["env.hz", "'fast'", "a number or None"]),
    "no_whole_number": (["run", "--env.episode-steps=1.5"], ["env.episode_steps", "'1.5'", "a whole number"]),
    "no_choice": (["run", "--env.on-miss", "panic"], ["env.on_miss", "'panic'", "hold, neutral"]),
    "no_entry": (["run", "--learner.hidden", "64", "x"], ["learner.hidden", "a whole number"]),
    "value_missing": (["run", "--seed"], ["seed", "a whole number"]),
    "endless_sim": (["sim", "pointmass", "--duration-s", "0"], ["duration_s", "0", "above 0"]),
    "process_without_run": (["agent", "pointmass"], ["run_dir", "must be given"]),
    "no_run_to_hold": (["hold"], ["run_dir", "runs/"]),
    "no_run_to_report": (["report", "taken"], ["run", "'taken'", "summary.json"]),
    "no_recording_to_view": (["view", "taken"], ["run", "'taken'", "recording.rrd"]),
    **{
        f"{algo}_in_{preset}": (["sim", preset, "--learner.algo", algo], ["learner.algo", f"'{algo}'"])
        for preset, algos in (
            ("cliffworld", ("fsac", "rsac", "tempo")),
            ("bandit", ("sac",)),
            ("random_mdp", ("fsac", "tempo")),
            ("chain", ("rsac", "tempo")),
            ("pointmass", ("fq", "npg", "tempo")),
            ("gym", ("q", "tempo")),
            ("halfcheetah", ("npg",)),
        )
        for algo in algos
    },
    "tempo_alone": (["env", "--config", "tempo.toml", "--run-dir", "new"], ["learner.algo", "'tempo'"]),
    "q_in_cartpole": (
        ["run", "gym", "--env.id", "CartPole-v1", "--learner.algo", "q"],
        ["learner.algo", "'q'", "'CartPole-v1'", "tables are for cliffworld, "],
    ),
    "eta": (
        ["run", "chain", "--learner.table.eta", "1.5"],
        ["learner.table.eta", "1.5", "(1 - learner.gamma) / learner.table.entropy"],
    ),
    "gamma_1_npg": (["run", "chain", "--learner.gamma", "1"], ["learner.gamma", "1.0", "below 1 for npg"]),
    "gamma_1_sac": (["run", "--learner.gamma", "1"], ["learner.gamma", "1.0", "below 1 for sac"]),
    "a_speed_that_is_not_observed": (
        ["run", "pointmass", "--learner.algo", "rsac", "--learner.reward.speed-entry", "1"],
        ["learner.reward.speed_entry", "1", "below 1"],
    ),
    "a_family_of_another_world": (
        ["run", "gym", "--learner.algo", "rsac"],
        ["learner.reward.model", "'declared'", "'learned'", "'Pendulum-v1'"],
    ),
    "states_that_are_observed_with_actions": (
        ["run", "cliffworld", "--env.observe-actions", "1"],
        ["env.observe_actions", "1"],
    ),
    "states_that_are_observed_with_the_drift": (
        ["run", "bandit", "--env.notify", "value"],
        ["env.notify", "'value'"],
    ),
    "index_missing": (
        ["env", "pointmass", "--env.count", "3", "--run-dir", "new"],
        ["index", "None", "0..2", "env.count = 3"],
    ),
    "index_too_high": (
        ["agent", "pointmass", "--env.count", "3", "--index", "3", "--run-dir", "new"],
        ["index", "3", "0..2"],
    ),
    "index_of_a_learner": (
        ["learn", "pointmass", "--env.count", "3", "--index", "0", "--run-dir", "new"],
        ["index", "0", "one learner"],
    ),
    "index_of_the_only_one": (
        ["env", "pointmass", "--index", "1", "--run-dir", "new"],
        ["index", "1", "one"],
    ),
    "index_is_no_number": (["env", "pointmass", "--index", "x", "--run-dir", "new"], ["index", "'x'"]),
    "too_many_environments": (["run", "pointmass", "--env.count", "17"], ["env.count", "17", "1..16"]),
    "report_of_nothing": (["report"], ["run", "must be given"]),
}


@pytest.fixture
def somewhere(tmp_path: Path) -> Path:
    return furnished(tmp_path)


def furnished(tmp_path: Path) -> Path:
    """A directory with what the mistakes refer to."""
    (tmp_path / "taken").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "good.toml").write_text("seed = 3\n")
    (tmp_path / "overlap.toml").write_text(OVERLAP)
    (tmp_path / "bad.toml").write_text(BAD_TOML)
    (tmp_path / "key.toml").write_text(UNKNOWN_KEY)
    (tmp_path / "range.toml").write_text(WRONG_RANGE)
    (tmp_path / "tempo.toml").write_text(PLAIN_PENDULUM + '[learner]\nalgo = "tempo"\n')
    return tmp_path


@dataclass(frozen=True)
class Refused:
    """What a command said, and what lay around it before and after."""

    done: subprocess.CompletedProcess[str]
    before: set[Path]
    after: set[Path]


@pytest.fixture(scope="module")
def typed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Future[Refused]]:
    """All of `TYPED`, as many at once as there are cores."""

    def refuse(name: str, place: Path) -> Refused:
        before = tree(place)
        done = tenuto(*TYPED[name][0], cwd=place)
        return Refused(done, before, tree(place))

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return {name: pool.submit(refuse, name, furnished(tmp_path_factory.mktemp(name))) for name in TYPED}


@pytest.mark.timeout(120)  # the first waits for all
@pytest.mark.parametrize("name", TYPED)
def test_wrong_input_is_one_line_and_leaves_nothing(name: str, typed: dict[str, Future[Refused]]) -> None:
    found = typed[name].result()
    assert found.done.returncode == 2, found.done.stderr
    assert found.done.stdout == ""
    check_line(found.done.stderr, TYPED[name][1])
    assert found.after == found.before


@pytest.mark.parametrize("name", OTHERS)
def test_so_are_rarer_mistakes(
    name: str, somewhere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, words = OTHERS[name]
    before = tree(somewhere)
    monkeypatch.chdir(somewhere)
    assert run_command(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    check_line(said.err, words)
    assert tree(somewhere) == before


def check_line(stderr: str, words: list[str]) -> None:
    assert stderr.startswith("tenuto: ")
    assert stderr.count("\n") == 1
    assert stderr.endswith("\n")
    for word in words:
        assert word in stderr


def test_a_run_that_has_ended_does_not_answer(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "run.toml").write_text("seed = 3\n")
    done = tenuto("stop", "--run-dir", str(run), cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr == f"tenuto: env_server does not answer in {run}: is the run still going?\n"


@pytest.mark.parametrize(
    "arguments",
    [["run", "--help"], ["env", "swimmer", "-h"], ["sim", "-h"], ["status", "-h"], ["view", "-h"]],
)
def test_help(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_:
        run_command(arguments)
    assert exit_.value.code in (0, None)
    assert f"usage: tenuto {arguments[0]}" in capsys.readouterr().out
    assert tree(tmp_path) == set()


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_the_list_of_commands(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(arguments) == 0
    listed = capsys.readouterr().out
    for command in COMMANDS:
        assert f"  {command.name} " in listed


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_command_of_the_table_exists(command: Command) -> None:
    assert callable(command.load())


def test_help_shows_the_values_of_the_preset(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run_command(["run", "swimmer", "--help"])
    shown = capsys.readouterr().out
    assert "(default: Swimmer-v5)" in shown
    assert "halfcheetah_authors" in shown
