from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from env_server.worlds.registry import resolve
from launcher import options, presets
from launcher.options import ProcessOptions, RunOptions, read
from rtcore.config import ConfigError, RunConfig, SuperviseConfig
from rtcore.config_check import check
from rtcore.config_io import dump_toml
from rtcore.run_dir import RunDir


def config_of(*argv: str) -> RunConfig:
    return read(RunOptions, argv, prog="tenuto run", description="")[0]


def test_every_section_of_a_run_can_be_set() -> None:
    own = {one.name for one in dataclasses.fields(RunConfig)}
    assert own - {one.name for one in dataclasses.fields(RunOptions)} == set()


@pytest.mark.parametrize("name", presets.names())
def test_presets_are_whole_and_named(name: str) -> None:
    preset = presets.load(name)
    assert preset.preset == name
    check(preset)
    resolved = resolve(preset.env)
    assert resolved.hz is not None
    assert resolved.hz > 0


def test_the_presets_that_users_are_promised() -> None:
    assert presets.names() == [
        "halfcheetah", "bandit", "bandit_conservative", "bandit_pessimistic", "chain", "cliffworld",
        "cliffworld_as_published", "gym", "halfcheetah_authors", "pointmass", "random_mdp", "swimmer",
    ]  # fmt: skip


def test_the_default_is_halfcheetah_at_200_hz() -> None:
    config = config_of()
    assert (config.preset, config.env.id, config.env.hz, config.env.speed) == (
        "halfcheetah",
        "HalfCheetah-v5",
        200.0,
        10.0,
    )
    assert config.duration_s == 120.0


def test_the_authors_unit_is_an_episode_of_a_thousand_steps() -> None:
    config = config_of("halfcheetah_authors")
    assert config.env.hz is not None
    assert config.env.unit_s * config.env.hz == config.env.episode_steps == 1000
    drift = config.env.drift
    assert (drift.offset, drift.amplitude, drift.omega) == (1.0, 0.2, 0.001)
    assert config.learner.algo == "fsac"


@pytest.mark.parametrize(
    ("argv", "hz", "speed"),
    [
        (["--env.hz", "100"], 100.0, 5.0),
        (["--env.hz=40"], 40.0, 2.0),
        (["--env.speed", "1"], 20.0, 1.0),
        (["--env.hz", "100", "--env.speed", "1"], 100.0, 1.0),  # 10 ms of physics per tick
    ],
)
def test_one_of_hz_and_speed_follows_from_the_other(argv: list[str], hz: float, speed: float) -> None:
    env = config_of("halfcheetah", *argv).env
    assert (env.hz, env.speed) == (hz, speed)


def test_the_preset_may_stand_anywhere() -> None:
    config = config_of("--seed", "5", "pointmass", "--learner.schedule.l-f", "4")
    assert (config.preset, config.seed, config.learner.schedule.l_f) == ("pointmass", 5, 4)


def test_short_flags_reach_the_recorder() -> None:
    recorder = config_of("--no-record", "--view", "web").recorder
    assert (recorder.record, recorder.view) == (False, "web")
    recorder = config_of("--recorder.no-record", "--recorder.view", "native").recorder
    assert (recorder.record, recorder.view) == (False, "native")


def test_a_saved_run_is_repeated_and_may_be_changed(tmp_path: Path) -> None:
    first = config_of("swimmer", "--seed", "3", "--no-record", "--env.drift.offset", "0.2")
    file = tmp_path / "run.toml"
    file.write_text(dump_toml(first))
    assert config_of("--config", str(file)) == first
    changed = config_of("--config", str(file), "--env.hz", "100", "--record")
    assert (changed.env.hz, changed.env.speed) == (100.0, 4.0)
    assert (changed.seed, changed.recorder.record, changed.env.drift.offset) == (3, True, 0.2)


def test_lists_and_alternatives() -> None:
    config = config_of(
        *["--learner.schedule.kind", "explicit", "--learner.schedule.t-m", "0", "13", "25"],
        *["--learner.schedule.g-m", "10", "4", "5", "--learner.alpha", "0.1", "--learner.hidden", "32"],
    )
    assert config.learner.schedule.t_m == (0, 13, 25)
    assert config.learner.schedule.g_m == (10, 4, 5)
    assert config.learner.alpha == 0.1
    assert config.learner.hidden == (32,)


def test_a_process_starts_from_the_run_that_is_there(tmp_path: Path) -> None:
    config = config_of("swimmer", "--seed", "9")
    run_dir = RunDir.create(tmp_path / "run", config)
    found, given = read(
        ProcessOptions,
        [
            "--run-dir",
            str(run_dir.path),
            "--connect",
            "tcp/127.0.0.1:7000",
            "--connect",
            "tcp/127.0.0.1:7001",
        ],
        prog="tenuto env",
        description="",
    )
    assert found == config
    assert given.connect == ("tcp/127.0.0.1:7000", "tcp/127.0.0.1:7001")


def test_a_unit_shorter_than_the_derived_tick_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"env\.unit_s = 0\.01: must be at least one tick"):
        config_of("--env.speed", "1", "--env.unit-s", "0.01")


def test_the_description_names_the_presets() -> None:
    assert options.describe("X.").startswith("X. PRESET is one of halfcheetah, bandit")


def test_supervision_is_set_on_the_command_line() -> None:
    supervise = config_of("pointmass", "--supervise.limit", "3", "--supervise.most-s", "2").supervise
    assert supervise == SuperviseConfig(limit=3, most_s=2.0)
