"""Whether a run's configuration holds: every field by its rule, and what fields must keep together."""

from __future__ import annotations

import dataclasses
from typing import get_type_hints

from rtcore.cast import env_names
from rtcore.config import (
    DEEP,
    TABULAR,
    ConfigError,
    DriftConfig,
    EnvConfig,
    ForecastConfig,
    LearnerConfig,
    RunConfig,
)
from rtcore.config_rules import rule_for
from rtcore.windows import make_schedule

LONGEST_OF_FLEET = 40  # characters in an environment's name; see `rtcore.tally`
LONGEST_CHOSEN = 1000  # units; its cost rises with the square: 0.2 s of the learner's thread for 36 states


def check(config: RunConfig) -> None:
    """Every field within its range, and the fields consistent with each other.

    Raises:
        ConfigError: the first field that is not, by its dotted name, with what is allowed.
    """
    _check_section(config, "")
    _check_together(config)


def check_unit(unit_s: float, hz: float) -> None:
    """A unit holds at least one tick. Whoever derives `env.hz` from `env.speed` asks again.

    Raises:
        ConfigError: it does not.
    """
    if round(unit_s * 1e9) < round(1e9 / hz):
        raise ConfigError("env.unit_s", unit_s, f"must be at least one tick, {1 / hz:g} s at {hz:g} Hz")


def _check_section(section: object, prefix: str) -> None:
    for key, hint in get_type_hints(type(section)).items():
        name, value = f"{prefix}{key}", getattr(section, key)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            if not isinstance(value, hint):
                raise ConfigError(name, value, f"must be of type {hint.__name__}")
            _check_section(value, f"{name}.")
        elif not (rule := rule_for(name, hint)).holds(value):
            raise ConfigError(name, value, rule.allowed)


def _check_together(config: RunConfig) -> None:
    env, learner = config.env, config.learner
    if env.hz is not None:
        check_unit(env.unit_s, env.hz)
    _check_names(env)
    for name in ("batch", "learning_starts"):
        value = getattr(learner, name)
        if value > learner.replay_capacity:
            allowed = f"must be <= learner.replay_capacity, which is {learner.replay_capacity}"
            raise ConfigError(f"learner.{name}", value, allowed)
    if config.supervise.first_s > config.supervise.most_s:
        allowed = f"must be <= supervise.most_s, which is {config.supervise.most_s:g}"
        raise ConfigError("supervise.first_s", config.supervise.first_s, allowed)
    _check_drift("env.drift", env.drift)
    for quantity in ("mass", "friction", "gravity"):
        _check_drift(f"env.physics.{quantity}", getattr(env.physics, quantity))
    _check_algorithm(learner)
    _check_forecast(learner.forecast)
    _check_schedule(learner)


def _check_names(env: EnvConfig) -> None:
    """A counter of a fleet ends with the environment's name, and a tally keeps 55 bytes of its own name."""
    longest = max(env_names(env), key=len)
    if env.count > 1 and len(longest) > LONGEST_OF_FLEET:
        most = LONGEST_OF_FLEET - len(str(env.count - 1))
        allowed = f"must be at most {most} characters, but for a number at its end, with env.count > 1"
        raise ConfigError("env.name", env.name, allowed)


def _check_drift(name: str, drift: DriftConfig) -> None:
    if drift.low is not None and drift.high is not None and drift.low > drift.high:
        raise ConfigError(f"{name}.low", drift.low, f"must be <= {name}.high, which is {drift.high:g}")
    if drift.kind == "burst" and 0 < drift.every <= drift.span:
        allowed = f"must be above {name}.span, which is {drift.span:g}, or 0 for one burst"
        raise ConfigError(f"{name}.every", drift.every, allowed)


def _check_algorithm(learner: LearnerConfig) -> None:
    table = learner.table
    if learner.algo in TABULAR and learner.hold_learning == "half":
        allowed = f"must be 'full' or 'off' for {learner.algo}: a table learns from each transition once"
        raise ConfigError("learner.hold_learning", "half", allowed)
    if learner.gamma == 1 and (learner.algo in DEEP or learner.algo == "npg"):
        raise ConfigError("learner.gamma", learner.gamma, f"must be below 1 for {learner.algo}")
    # the largest eta itself may land a rounding above it: 1 - 0.9 is 0.09999999999999998
    if learner.algo == "npg" and table.eta * table.entropy > (1 - learner.gamma) * (1 + 1e-9):
        most = (1 - learner.gamma) / table.entropy
        allowed = f"must be <= (1 - learner.gamma) / learner.table.entropy, which is {most:g}"
        raise ConfigError("learner.table.eta", table.eta, allowed)


def _check_schedule(learner: LearnerConfig) -> None:
    schedule = learner.schedule
    choosing: dict[str, tuple[str, ...]] = {"auto": ("npg", "fsac"), "auto_bound": ("npg",)}
    if (able := choosing.get(schedule.kind)) is not None:
        if learner.algo not in able:
            allowed = f"must go with learner.algo {' or '.join(able)}, by whose forecasts it chooses"
            raise ConfigError("learner.schedule.kind", schedule.kind, allowed)
        if learner.forecast.kind == "none" or learner.forecast.parity == "authors":
            raise ConfigError("learner.schedule.kind", schedule.kind, "must have a forecast to choose by")
        if schedule.l_f > LONGEST_CHOSEN:
            allowed = f"must be <= {LONGEST_CHOSEN} for a schedule that chooses: it tries every G"
            raise ConfigError("learner.schedule.l_f", schedule.l_f, allowed)
        if schedule.least_update > schedule.l_f:
            allowed = f"must be <= learner.schedule.l_f, which is {schedule.l_f}"
            raise ConfigError("learner.schedule.least_update", schedule.least_update, allowed)
    make_schedule(schedule)


def _check_forecast(forecast: ForecastConfig) -> None:
    if forecast.parity == "authors" and forecast.distil:
        raise ConfigError(
            "learner.forecast.distil", True, "must be false with parity 'authors': it has no copies"
        )
    columns = {
        "constant": 1,
        "identity": 2,
        "polynomial": 1 + forecast.degree,
        "fourier": 1 + 2 * forecast.harmonics,
    }[forecast.basis]
    if forecast.kind == "forq" and forecast.l_p < columns:
        allowed = f"must be >= {columns} for the {forecast.basis} basis"
        raise ConfigError("learner.forecast.l_p", forecast.l_p, allowed)
