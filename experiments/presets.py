"""Presets: functions that return a whole run configuration, found by the entry points in pyproject.toml.

Those of the finite worlds are in `experiments.finite_presets`. `run` fills in the preset's name; every value
can be overridden on the command line.
"""

from __future__ import annotations

import math

from rtcore.config import (
    DriftConfig,
    EnvConfig,
    ForecastConfig,
    LearnerConfig,
    RewardConfig,
    RewardModelConfig,
    RunConfig,
    ScheduleConfig,
)

# Where Gymnasium's observations hold the forward speed, for `rsac`.
_HALFCHEETAH = RewardModelConfig(speed_entry=8)
_SWIMMER = RewardModelConfig(speed_entry=3)


def halfcheetah() -> RunConfig:
    """MuJoCo's HalfCheetah at 200 Hz, ten times faster than native, chasing a speed it cannot see.

    The target swings between 1 and 3 m/s once in 60 units; episodes are 5 s of simulated time. Two
    minutes are 24 000 ticks, so everything here is chosen to learn from little: small networks, so that
    one core makes two updates per tick, high learning rates, and a replay of a minute, because older
    rewards belong to another target. `docs/learning.md` has the measurements.
    """
    return RunConfig(
        preset="halfcheetah",
        env=EnvConfig(
            id="HalfCheetah-v5",
            speed=10.0,
            episode_steps=100,
            drift=DriftConfig(kind="sine", offset=2.0, amplitude=1.0, omega=2 * math.pi / 60),
            reward=RewardConfig(control_cost=0.05),
        ),
        learner=LearnerConfig(
            algo="sac",
            utd=2.0,
            hidden=(128, 128),
            batch=128,
            gamma=0.99,
            tau=0.01,
            actor_lr=3e-3,
            critic_lr=3e-3,
            alpha_lr=3e-3,
            replay_units=60.0,
            reward=_HALFCHEETAH,
        ),
    )


def halfcheetah_authors() -> RunConfig:
    """HalfCheetah with the drift of the paper's authors: offset 1.0, a = 0.2, omega = 0.001 per episode.

    Their unit of time is an episode of 1000 steps, so `unit_s` is 1000 control periods: 5 s at 200 Hz.
    The learner is FSAC with SAC settings from the middle of their grids (learning rates 3e-4, tau 0.005,
    fixed temperature 0.03) and their code's 10 000 random steps before the first update.
    """
    steps, hz = 1000, 200.0
    return RunConfig(
        preset="halfcheetah_authors",
        env=EnvConfig(
            id="HalfCheetah-v5",
            hz=hz,
            episode_steps=steps,
            unit_s=steps / hz,
            drift=DriftConfig(kind="sine", offset=1.0, amplitude=0.2, omega=0.001),
        ),
        learner=LearnerConfig(
            algo="fsac",
            alpha=0.03,
            learning_starts=10_000,
            schedule=ScheduleConfig(kind="fixed", l_f=10, gamma_f=0.7),
            forecast=ForecastConfig(kind="forq", l_p=10, basis="identity"),
            reward=_HALFCHEETAH,
        ),
    )


def swimmer() -> RunConfig:
    """MuJoCo's Swimmer at 200 Hz, eight times faster than native, chasing a speed within its reach."""
    return RunConfig(
        preset="swimmer",
        env=EnvConfig(
            id="Swimmer-v5",
            speed=8.0,
            episode_steps=200,
            drift=DriftConfig(kind="sine", offset=0.1, amplitude=0.1, omega=2 * math.pi / 120),
            reward=RewardConfig(control_cost=1e-4),
        ),
        learner=LearnerConfig(reward=_SWIMMER),
    )


def pointmass() -> RunConfig:
    """A point on a line, cheap: first steps and tests."""
    return RunConfig(
        preset="pointmass",
        env=EnvConfig(
            id="pointmass",
            hz=100.0,
            episode_steps=100,
            drift=DriftConfig(kind="sine", offset=0.0, amplitude=0.5, omega=2 * math.pi / 60),
            reward=RewardConfig(control_cost=0.01),
        ),
        # Return per step, last third of two simulated minutes, seed 3: -0.10, against -0.40 with the
        # library's defaults (gamma 0.99, learning rates 3e-4, all of the replay) and -0.37 for pi_0.
        learner=LearnerConfig(
            hidden=(64, 64),
            batch=128,
            learning_starts=200,
            gamma=0.9,
            actor_lr=3e-3,
            critic_lr=3e-3,
            alpha_lr=3e-3,
            replay_units=3.0,
        ),
    )


def gym() -> RunConfig:
    """Any Gymnasium environment with continuous actions (`--env.id`; Pendulum-v1), without drift."""
    return RunConfig(
        preset="gym",
        env=EnvConfig(id="Pendulum-v1", hz=50.0, episode_steps=200, drift=DriftConfig(kind="none")),
    )
