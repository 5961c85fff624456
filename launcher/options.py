"""What `run`, `sim` and the single processes take on the command line, and the run that it means.

A command line is read twice: once for PRESET and --config, whose values are then the defaults of the
second reading.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from tyro.conf import Positional, UseAppendAction

from env_server.worlds import registry as worlds
from launcher import presets
from launcher.parsing import HELP_FLAGS, given, parse
from learner.schedule.timetable import require_constants
from rtcore.config import (
    AgentConfig,
    ConfigError,
    EnvConfig,
    LearnerConfig,
    LinkConfig,
    RecorderConfig,
    RunConfig,
    SuperviseConfig,
)
from rtcore.config_check import check
from rtcore.config_io import load_toml
from rtcore.run_dir import RunDir
from rtcore.signing import identity
from rtcore.zenoh_config import require_tls


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """A run: a preset or a file, and what differs from it."""

    preset: Positional[str | None] = None
    """PRESET, the run to start from."""
    config: Path | None = None
    """A run.toml to start from, instead of PRESET."""
    run_dir: Path | None = None
    """Where the run's files go; it must not exist yet. None: runs/<utc>-<preset>."""
    duration_s: float = 120.0
    """Seconds of run time; 0: until stopped."""
    seed: int = 0
    """The same seed gives the same run in virtual time."""
    record: bool = True
    """Write recording.rrd. Short for --recorder.record."""
    view: Literal["none", "web", "native"] = "none"
    """Show the run live. Short for --recorder.view."""
    env: EnvConfig = field(default_factory=EnvConfig)
    agent: AgentConfig = field(default_factory=AgentConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    recorder: RecorderConfig = field(default_factory=RecorderConfig)
    link: LinkConfig = field(default_factory=LinkConfig)
    supervise: SuperviseConfig = field(default_factory=SuperviseConfig)


@dataclass(frozen=True, kw_only=True)
class ProcessOptions(RunOptions):
    """One process of a run."""

    connect: Annotated[tuple[str, ...], UseAppendAction] = ()
    """A further endpoint to connect to; may be given several times."""
    listen: Annotated[tuple[str, ...], UseAppendAction] = ()
    """A further endpoint to listen on; may be given several times."""
    router: str = ""
    """The Zenoh router, like tcp/host:7447, to reach the others through, and nothing else."""
    index: int | None = None
    """Of a fleet's environment, from 0: which env server or agent."""


SHORT = {"--learner.schedule": "--learner.schedule.kind"}  # what a section is mostly asked for by

OptionsT = TypeVar("OptionsT", bound=RunOptions)


def read(
    kind: type[OptionsT], argv: Sequence[str], *, prog: str, description: str
) -> tuple[RunConfig, OptionsT]:
    """The run that a command line asks for, checked and resolved, and the options themselves.

    Args:
        kind: what the command line may hold. `ProcessOptions` also start from the run.toml of an
            existing `run_dir`.
        argv: the command line.
        prog: how the command is called.
        description: what it does, for the help.

    Raises:
        ConfigError: anything about it is wrong. Nothing was created.
        SystemExit: help was printed.
    """
    argv = [_whole(token) for token in argv]
    wants_help = any(token in HELP_FLAGS for token in argv)
    plain = [token for token in argv if token not in HELP_FLAGS]
    try:
        base = _base(parse(kind, plain, prog=prog, description=description))
    except ConfigError:
        if not wants_help:
            raise
        base = presets.load(presets.DEFAULT)
    default = _as_options(kind, base, argv)
    options = parse(kind, argv, prog=prog, description=description, default=default)
    return _resolved(_as_config(options, default, base.preset)), options


def _resolved(config: RunConfig) -> RunConfig:
    """Checked, with `hz` and `speed` both filled in."""
    worlds.require_fit(config.env, config.learner.algo)  # first: rules of an algorithm are beside the point
    check(config)
    link = replace(config.link, secure=_absolute(config.link.secure))
    resolved = replace(config, env=worlds.resolve(config.env), link=link)
    check(resolved)  # again, now that hz and speed are both known
    require_constants(config.learner.schedule)
    if config.learner.algo == "rsac":
        worlds.require_speed(resolved.env, config.learner.reward)
    return resolved


def require_keys(link: LinkConfig, roles: Iterable[str], endpoints: Sequence[str] = ()) -> None:
    """Where links are secured, see that they can be, before anything is made.

    Raises:
        ConfigError: a certificate or an endpoint does not do.
    """
    if link.secure:
        for role in roles:
            identity(link.secure, role)
        require_tls((*link.connect, *link.listen, *endpoints))


def _absolute(path: str) -> str:
    """Processes, and commands about them, may start elsewhere."""
    return str(Path(path).absolute()) if path else ""


def _whole(token: str) -> str:
    """A flag as tyro knows it: `--learner.schedule auto` and `--learner.schedule=auto` name the kind."""
    flag, equals, value = token.partition("=")
    return SHORT.get(flag, flag) + equals + value


def describe(summary: str) -> str:
    """A help text that names the presets."""
    return f"{summary} PRESET is one of {', '.join(presets.names())}."


def _base(options: RunOptions) -> RunConfig:
    if options.config is not None:
        if options.preset is not None:
            raise ConfigError(
                "config", str(options.config), f"not together with the preset '{options.preset}'"
            )
        return load_toml(options.config)
    if options.preset is None and isinstance(options, ProcessOptions) and options.run_dir is not None:
        run_dir = RunDir(options.run_dir)
        if run_dir.config_path.is_file():
            return run_dir.config()
    return presets.load(options.preset or presets.DEFAULT)


def _as_options(kind: type[OptionsT], base: RunConfig, argv: Sequence[str]) -> OptionsT:
    """The base's values as defaults. One of hz and speed follows from the other, so whoever gives
    one of them takes the base's other one back.
    """
    env = base.env
    hz, speed = given("--env.hz", argv), given("--env.speed", argv)
    if hz and not speed:
        env = replace(env, speed=None)
    if speed and not hz:
        env = replace(env, hz=None)
    return kind(
        duration_s=base.duration_s,
        seed=base.seed,
        record=base.recorder.record,
        view=base.recorder.view,
        env=env,
        agent=base.agent,
        learner=base.learner,
        recorder=base.recorder,
        link=base.link,
        supervise=base.supervise,
    )


def _as_config(options: RunOptions, default: RunOptions, preset: str) -> RunConfig:
    recorder = options.recorder
    if options.record != default.record:
        recorder = replace(recorder, record=options.record)
    if options.view != default.view:
        recorder = replace(recorder, view=options.view)
    return RunConfig(
        preset=preset,
        seed=options.seed,
        duration_s=options.duration_s,
        env=options.env,
        agent=options.agent,
        learner=options.learner,
        recorder=recorder,
        link=options.link,
        supervise=options.supervise,
    )
