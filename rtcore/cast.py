"""Who takes part in a run: one process per role, or of a fleet an env server and an agent per environment.

Everything that names a process or an environment of a run follows from here, in connect order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from rtcore.channels import PER_ENV, PROCESSES
from rtcore.config import ConfigError, EnvConfig, RunConfig

_DIGITS = "0123456789"


@dataclass(frozen=True, slots=True)
class Part:
    """A process of a run.

    Attributes:
        role: one of `channels.PROCESSES`.
        index: of its environment in a fleet, from 0; None: it serves all there are.
    """

    role: str
    index: int | None = None

    @property
    def name(self) -> str:
        """The process's name in keys, files and counters: `learner`, or of a fleet `env_server.2`."""
        return self.role if self.index is None else f"{self.role}.{self.index}"

    @property
    def number(self) -> int:
        """Of its environment, 0 where there is one: what keeps the random numbers of a fleet apart."""
        return self.index or 0


def role_of(process: str) -> str:
    """The role of the process of that name."""
    return process.partition(".")[0]


def index_of(process: str) -> int | None:
    """The environment's index in the name of a process; None where it has none."""
    index = process.partition(".")[2]
    return int(index) if index.isdecimal() else None


def env_names(env: EnvConfig) -> tuple[str, ...]:
    """The environments' names: `env.name`, or of a fleet that with 0, 1, ... for a number at its end."""
    if env.count == 1:
        return (env.name,)
    return tuple(f"{env.name.rstrip(_DIGITS)}{index}" for index in range(env.count))


def offset_ns(number: int, count: int, tick_ns: int) -> int:
    """How long after T0 the first deadline of environment `number` of `count` is. Theirs are spread evenly
    over a period, so that they do not all want the same core at once."""
    return number * tick_ns // count


def parts(config: RunConfig, *, record: bool = True) -> tuple[Part, ...]:
    """All processes, in connect order: each connects to the earlier ones.

    Args:
        config: of the run.
        record: with the recorder.
    """
    roles = [role for role in PROCESSES if record or role != PROCESSES[-1]]
    fleet = config.env.count > 1
    return tuple(
        Part(role, index)
        for role in roles
        for index in (range(config.env.count) if fleet and role in PER_ENV else (None,))
    )


def names(config: RunConfig, *, record: bool = True) -> tuple[str, ...]:
    """The names of `parts`."""
    return tuple(part.name for part in parts(config, record=record))


def of_role(config: RunConfig, role: str) -> tuple[str, ...]:
    """The names of the processes of one role."""
    return tuple(part.name for part in parts(config) if part.role == role)


def part_for(config: RunConfig, role: str, index: int | None) -> Part:
    """The part that a process is to play.

    Args:
        config: of the run.
        role: one of `channels.PROCESSES`.
        index: of its environment, as it was asked for; None: it was not.

    Raises:
        ConfigError: a fleet has several of this role and none was named, or one was that it has not.
    """
    wanted = Part(role, index)
    if wanted in (allowed := [part for part in parts(config) if part.role == role]):
        return wanted
    if index == 0 and len(allowed) == 1 and role in PER_ENV:
        return allowed[0]
    if len(allowed) > 1:
        raise ConfigError("index", index, f"must be in 0..{len(allowed) - 1}: env.count = {len(allowed)}")
    raise ConfigError("index", index, f"must not be given: the run has one {role}")


def as_part(config: RunConfig, part: Part) -> RunConfig:
    """The configuration as the process goes by it: with the name of its own environment."""
    if part.index is None:
        return config
    return replace(config, env=replace(config.env, name=env_names(config.env)[part.index]))
