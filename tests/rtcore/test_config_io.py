from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcore.config import (
    ConfigError,
    DriftConfig,
    EnvConfig,
    ForecastConfig,
    LearnerConfig,
    LinkConfig,
    RecorderConfig,
    RunConfig,
    ScheduleConfig,
)
from rtcore.config_check import check
from rtcore.config_io import dump_toml, from_table, load_toml

PAPER = RunConfig(
    preset="paper",
    seed=7,
    duration_s=30,
    env=EnvConfig(id="Swimmer-v5", hz=50, drift=DriftConfig(kind="none", phase=-0.5), observe_actions=2),
    learner=LearnerConfig(
        alpha=0.2,
        hidden=(64,),
        replay_units=20.0,
        schedule=ScheduleConfig(kind="explicit", t_m=(0, 13, 25), g_m=(10, 4, 5)),
        forecast=ForecastConfig(kind="none", horizon=3.5),
    ),
    recorder=RecorderConfig(record=False, view="web"),
    link=LinkConfig(connect=("tls/192.0.2.1:7447",)),
)


def load_text(tmp_path: Path, text: str) -> RunConfig:
    path = tmp_path / "run.toml"
    path.write_text(text, encoding="utf-8")
    return load_toml(path)


@pytest.mark.parametrize("config", [RunConfig(), PAPER])
def test_what_is_dumped_loads_as_it_was(tmp_path: Path, config: RunConfig) -> None:
    assert load_text(tmp_path, dump_toml(config)) == config


number = st.floats(1e-6, 1e6)


@given(
    st.builds(
        RunConfig,
        seed=st.integers(0, 2**32 - 1),
        duration_s=number,
        env=st.builds(
            EnvConfig,
            id=st.text(st.characters(codec="utf-8", categories=("L", "N", "P")), min_size=1, max_size=20),
            hz=st.none() | number,
            speed=st.none() | number | st.integers(1, 100),
            unit_s=number,
            drift=st.builds(DriftConfig, amplitude=st.floats(allow_nan=False, allow_infinity=False)),
        ),
        learner=st.builds(
            LearnerConfig,
            alpha=number | st.just("auto"),
            hidden=st.lists(st.integers(1, 512), min_size=1, max_size=3).map(tuple),
            target_entropy=st.none() | st.floats(-10, 10),
            schedule=st.builds(ScheduleConfig, gamma_f=st.floats(0.01, 1), l_f=st.integers(1, 99)),
        ),
    )
)
def test_any_configuration_survives_the_round_trip(config: RunConfig) -> None:
    assert from_table(tomllib.loads(dump_toml(config))) == config


def test_what_is_none_is_left_out(tmp_path: Path) -> None:
    text = dump_toml(RunConfig())
    assert "hz" not in text and "replay_units" not in text and "None" not in text
    assert "on_miss" in text  # while a default that is not None is there
    assert load_text(tmp_path, text).env.hz is None


def test_what_a_file_leaves_out_has_its_default(tmp_path: Path) -> None:
    assert load_text(tmp_path, "") == RunConfig()
    config = load_text(tmp_path, "seed = 3\n[learner.schedule]\nl_f = 5\n")
    assert config == RunConfig(seed=3, learner=LearnerConfig(schedule=ScheduleConfig(l_f=5)))


def test_an_integer_does_for_a_number(tmp_path: Path) -> None:
    config = load_text(tmp_path, "[env]\nhz = 50\n[learner]\nalpha = 1\n")
    assert config.env.hz == 50.0 and isinstance(config.env.hz, float)
    assert config.learner.alpha == 1.0
    check(config)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[env]\nhz = 'fast'", "env.hz = 'fast': must be a number"),
        ("[env]\nhz = true", "env.hz = True: must be a number"),
        ("[env]\nepisode_steps = 1.5", "env.episode_steps = 1.5: must be an integer"),
        ("seed = '1'", "seed = '1': must be an integer"),
        ("seed = true", "seed = True: must be an integer"),
        ("preset = 3", "preset = 3: must be a string"),
        ("[recorder]\nrecord = 1", "recorder.record = 1: must be true or false"),
        ("[learner]\nalpha = 'on'", "learner.alpha = 'on': must be a number or 'auto'"),
        ("[learner]\nhidden = 64", "learner.hidden = 64: must be an array, each entry an integer"),
        (
            "[learner]\nhidden = [64, 'x']",
            "learner.hidden = [64, 'x']: must be an array, each entry an integer",
        ),
        (
            "[learner.schedule]\nrounding = 'up'",
            "learner.schedule.rounding = 'up': must be one of 'floor', 'ceil', 'paper_le'",
        ),
        ("env = 3", "env = 3: must be a table"),
        ("learner = {schedule = []}", "learner.schedule = []: must be a table"),
        (
            "[agent]\nrealtime = 'off'",
            "agent.realtime = 'off': unknown key; allowed here: rt",
        ),
        (
            '[link]\n"con\\nnect" = []',
            "link.con\\nnect = []: unknown key; allowed here: connect, listen, secure",
        ),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_text(tmp_path, text)
    assert str(error.value) == message


def test_an_unknown_key_at_the_top_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"^sead = 1: unknown key; allowed here: preset, seed, duration_s, env,"
    ):
        load_text(tmp_path, "sead = 1")


def test_dates_and_huge_numbers_are_no_values(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^duration_s = .*: must be a number$"):
        load_text(tmp_path, "duration_s = 2020-01-01")
    with pytest.raises(ConfigError, match=r"^duration_s = 1000+: must be a number$"):
        load_text(tmp_path, "duration_s = 1" + "0" * 400)


def test_infinities_load_and_are_checked_away(tmp_path: Path) -> None:
    config = load_text(tmp_path, "duration_s = inf")
    with pytest.raises(ConfigError, match="duration_s = inf"):
        check(config)


def test_files_that_are_none(tmp_path: Path) -> None:
    missing = tmp_path / "none.toml"
    with pytest.raises(ConfigError) as error:
        load_toml(missing)
    assert (
        str(error.value) == f"config = {str(missing)!r}: must be a readable file (No such file or directory)"
    )
    with pytest.raises(ConfigError, match=r"must be a readable file \(Is a directory\)"):
        load_toml(tmp_path)
    for content in (b"seed = ", b"\xff\xfe", b"a = " + b"[" * 5000, b"seed = 1\nseed = 2"):
        path = tmp_path / "bad.toml"
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=r"^config = .*bad\.toml': must be valid TOML \(") as bad:
            load_toml(path)
        assert len(str(bad.value).splitlines()) == 1
