"""The constants of a plan, and where each of them comes from: a flag, a file, a run, or nowhere."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

from launcher.plan.envelope import Envelope
from learner.theory.optimum import HoldProblem
from rtcore.config import ConfigError

NAMES = tuple(one.name for one in fields(HoldProblem))
# Only ratios matter, so these may be left out; and both phases are alike unless said otherwise.
UNITS = {"c_1": 1.0, "b_1": 1.0}
LIKE = {"alpha_2": "alpha_1", "b_2": "b_1"}
LONGEST = 100_000  # window: every N has a row in plan.json, 100 bytes

Number = int | float


@dataclass(frozen=True)
class Estimate:
    """The constants that a run gives, where each comes from, and what else was assumed."""

    values: dict[str, Number]
    origins: dict[str, str]
    unit_s: float
    remarks: tuple[str, ...]
    envelopes: tuple[Envelope, Envelope]


@dataclass(frozen=True)
class Plan:
    """What is to be planned.

    Attributes:
        problem: the constants.
        origins: for each of them where it comes from, in words.
        unit_s: seconds of a unit; None where no run says it.
        remarks: what else was assumed.
        envelopes: of the update and the hold, as fitted to a run's drift; None without a run.
    """

    problem: HoldProblem
    origins: Mapping[str, str]
    unit_s: float | None = None
    remarks: tuple[str, ...] = ()
    envelopes: tuple[Envelope, Envelope] | None = field(default=None, repr=False)


def check_window(window: Number) -> int:
    """A window of a length that can be listed.

    Raises:
        ConfigError: it is not.
    """
    if not 1 <= window <= LONGEST:
        raise ConfigError("window", window, f"must be in 1..{LONGEST}, in units")
    return int(window)


def read_constants(path: Path) -> dict[str, Number]:
    """Constants from a TOML file of `name = number` lines.

    Raises:
        ConfigError: it cannot be read, is no TOML, or has an unknown name or something that is no number.
    """
    try:
        table = tomllib.loads(path.read_text())
    except OSError as error:
        raise ConfigError("config", str(path), f"must be a readable file ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError("config", str(path), f"must be valid TOML ({error})") from error
    for name, value in table.items():
        if name not in NAMES:
            raise ConfigError(repr(name)[1:-1], value, f"unknown key; allowed here: {', '.join(NAMES)}")
        whole = name == "window"
        if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
            raise ConfigError(name, value, "must be an integer" if whole else "must be a number")
    return table


def settle(
    flags: Mapping[str, Number], file: Mapping[str, Number] | None = None, run: Estimate | None = None
) -> Plan:
    """One value for each constant: the flag's, else the file's, else the run's, else a neutral one.

    Raises:
        ConfigError: a constant is missing or out of its range, or an alpha is not above 1 where a B is.
    """
    values: dict[str, Number] = {}
    origins: dict[str, str] = {}
    for name in NAMES:
        if name in flags:
            values[name], origins[name] = flags[name], "flag"
        elif file and name in file:
            values[name], origins[name] = file[name], "file"
        elif run:
            values[name], origins[name] = run.values[name], run.origins[name]
        elif name in UNITS:
            values[name], origins[name] = UNITS[name], "default"
        elif (other := LIKE.get(name)) is not None:
            values[name], origins[name] = values[other], f"as {other}"
        else:
            raise ConfigError(name, None, "must be given: by a flag, in --config, or through a RUN")
    window = check_window(values.pop("window"))
    problem = HoldProblem(window=window, **{name: float(value) for name, value in values.items()})
    for alpha, scale in (("alpha_1", "b_1"), ("alpha_2", "b_2")):
        if values[scale] and not values[alpha] > 1:
            raise ConfigError(
                alpha, values[alpha], f"must be above 1 with a {scale} above 0, by Assumption 1"
            )
    if run is None:
        return Plan(problem, origins)
    return Plan(problem, origins, run.unit_s, run.remarks, run.envelopes)
