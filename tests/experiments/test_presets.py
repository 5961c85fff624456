"""What the presets promise, beyond being valid (`tests/launcher/test_options.py` tries each)."""

from __future__ import annotations

import importlib
import math
import tomllib
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from env_server.worlds.registry import resolve
from experiments import finite_presets, presets
from launcher import presets as installed
from rtcore.config import RunConfig
from rtcore.windows import make_schedule

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"
FINITE = ("cliffworld", "bandit", "random_mdp", "chain")


def preset(name: str) -> RunConfig:
    return installed.load(name)


def test_what_is_installed_is_what_pyproject_declares() -> None:
    """Otherwise `make` was not run since: `tenuto run PRESET` would not find it."""
    declared = tomllib.loads(PYPROJECT.read_text())["project"]["entry-points"]["tenuto.presets"]
    assert sorted(declared) == sorted(installed.names())
    for name, target in declared.items():
        module, _, function = target.partition(":")
        assert function == name
        assert getattr(importlib.import_module(module), function)().preset == name


def test_every_preset_is_declared() -> None:
    own = {
        name
        for module in (presets, finite_presets)
        for name, thing in vars(module).items()
        if not name.startswith("_") and getattr(thing, "__module__", "") == module.__name__
    }
    assert own == set(installed.names())


@pytest.mark.parametrize("name", ["cliffworld", "cliffworld_as_published"])
def test_the_goal_moves_in_the_middle(name: str) -> None:
    config = preset(name)
    assert config.env.drift.kind == "switch"
    assert config.env.drift.at == config.duration_s / config.env.unit_s / 2


def test_as_published_has_the_papers_numbers() -> None:
    config = preset("cliffworld_as_published")
    cliff, table = config.env.cliff, config.learner.table
    assert (cliff.step_reward, cliff.goal_reward, cliff.restart_reward) == (-100, 100, -100)
    assert (table.step_size, table.epsilon) == (0.1, 0.1)
    assert config.env.episode_steps == 100
    assert config.env.hz is not None
    assert config.duration_s * config.env.hz == 20_000
    assert config.env.drift.at == 10_000 / (config.env.unit_s * config.env.hz)
    assert config.learner.algo == "fq"


@pytest.mark.parametrize("name", ["bandit", "bandit_conservative", "bandit_pessimistic"])
def test_the_arms_swap_once_and_at_any_time_of_the_run(name: str) -> None:
    config = preset(name)
    drift = config.env.drift
    assert (drift.kind, drift.at, drift.every) == ("switch", "random", 0)
    assert (drift.offset, drift.offset + drift.amplitude) == (0, 1)  # P(reward) of the first arm
    assert drift.span * config.env.unit_s == config.duration_s


def test_one_tempo_is_early_and_the_other_late() -> None:
    """The swap comes at half of the run on average."""
    early, late = preset("bandit_conservative"), preset("bandit_pessimistic")
    assert early.learner.algo == late.learner.algo == "tempo"
    middle = early.duration_s / early.env.unit_s / 2
    assert early.learner.table.tempo_begin + early.learner.table.tempo_span < middle
    assert middle < late.learner.table.tempo_begin
    assert late.learner.table.tempo_begin + late.learner.table.tempo_span <= 2 * middle
    assert early.env == late.env == preset("bandit").env


@pytest.mark.parametrize("name", ["random_mdp", "chain"])
def test_algorithm_1_updates_for_7_of_20_units_of_an_episode_each(name: str) -> None:
    config = preset(name)
    assert config.learner.algo == "npg"
    window = make_schedule(config.learner.schedule).window_at(0)
    assert (window.update, window.hold) == (7, 13)
    assert config.env.hz is not None
    assert config.env.unit_s * config.env.hz == config.env.episode_steps + 1  # with its reset
    assert config.env.drift.omega == 2 * math.pi / 160
    table = config.learner.table
    assert 1 - table.eta * table.entropy / (1 - config.learner.gamma) == pytest.approx(0.8)  # beta


@pytest.mark.parametrize("name", FINITE)
def test_tables_learn_from_the_first_tick_and_are_published_every_second_at_least(name: str) -> None:
    config = preset(name)
    assert config.learner.learning_starts == 0
    assert resolve(config.env).hz is not None
    assert config.env.unit_s <= 1.0
    hz = config.env.hz
    assert hz is not None and config.duration_s * hz <= config.learner.replay_capacity


@pytest.mark.parametrize("name", ["halfcheetah", "halfcheetah_authors", "swimmer"])
def test_rsac_reads_the_forward_speed(name: str) -> None:
    """As the simulator has it, against the entry of the observation that the preset names."""
    config = preset(name)
    env = gymnasium.make(config.env.id)
    env.reset(seed=1)
    try:
        for _ in range(5):
            observation = env.step(np.ones(env.action_space.shape or ()))[0]
            speed = env.unwrapped.data.qvel[0]  # type: ignore[attr-defined]
            assert observation[config.learner.reward.speed_entry] == speed != 0
    finally:
        env.close()


def test_rsac_reads_the_only_entry_of_the_point_mass() -> None:
    assert preset("pointmass").learner.reward.speed_entry == 0
