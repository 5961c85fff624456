"""The run card: what this recording is of, as a page of text inside it. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from recorder.student import student_rows
from rtcore.cast import env_names
from rtcore.config import DriftConfig, DriftKind, EnvConfig, RunConfig
from rtcore.messages import Spec


def run_card(run: str, config: RunConfig, spec: Spec, placements: Mapping[str, str]) -> str:
    """Markdown. `placements` says per process what the system granted it."""
    world = [
        ("environment", f"`{spec.env_id}` ({_spaces(spec)})"),
        *_fleet(config.env),
        ("rate", _rate(spec)),
        ("episode", f"{config.env.episode_steps} ticks"),
        ("unit t", f"{spec.unit_ns / 1e9:g} s"),
        *_changes(config.env),
        ("action delay", f"{spec.action_delay_ticks} ticks"),
        ("on a miss", config.env.on_miss),
    ]
    duration = f"{config.duration_s:g} s" if config.duration_s else "until stopped"
    head = [("preset", f"`{config.preset}`"), ("seed", str(config.seed)), ("duration", duration)]
    page = [
        f"# {run}",
        _table(head),
        "## World",
        _table(world),
        "## Learner",
        _table(student_rows(config.learner)),
    ]
    if placements:
        page += ["## Placement", _table(sorted(placements.items()))]
    return "\n\n".join(page) + "\n"


def _fleet(env: EnvConfig) -> list[tuple[str, str]]:
    names = env_names(env)
    if len(names) == 1:
        return []
    return [("fleet", f"{len(names)} of it, {names[0]} to {names[-1]}, with an agent each")]


def _spaces(spec: Spec) -> str:
    if spec.states:
        return f"{spec.states} states, {spec.actions} actions"
    return f"{spec.observation_dim} observations, {spec.action_dim} actions"


def _rate(spec: Spec) -> str:
    rate = f"{1e9 / spec.tick_ns:g} Hz, so a deadline every {spec.tick_ns / 1e6:g} ms"
    if spec.native_period_ns == 0:
        return rate
    return f"{rate}; {spec.native_period_ns / spec.tick_ns:g} x native speed"


def _changes(env: EnvConfig) -> list[tuple[str, str]]:
    """What drifts, and what the agent is told of it."""
    factors = {name: getattr(env.physics, name) for name in ("mass", "friction", "gravity")}
    drifting = [
        (f"factor on {name}", _drift(drift)) for name, drift in factors.items() if drift.kind != "none"
    ]
    told = {"none": [], "changed": [("told", "when it changes")], "value": [("told", "the drift's value")]}
    return [("drift", _drift(env.drift)), *drifting, *told[env.notify]]


def _drift(drift: DriftConfig) -> str:
    if drift.kind == "none":
        return "none"
    bounds = [f"at least {drift.low:g}"] if drift.low is not None else []
    bounds += [f"at most {drift.high:g}"] if drift.high is not None else []
    own_seed = [f"seed {drift.seed}"] if drift.seed is not None else []
    return ", ".join([_formula(drift), *bounds, *own_seed])


def _formula(drift: DriftConfig) -> str:
    """A kind's value in unit t, in words."""
    rest, other, sd = f"{drift.offset:g}", f"{drift.offset + drift.amplitude:g}", f"{drift.sd:g}"
    at = f"a random unit below {drift.span:g}" if drift.at == "random" else f"t = {drift.at:g}"
    wave = f"sin({drift.omega:g} t{f' + {drift.phase:g}' if drift.phase else ''})"
    again = f"every {drift.every:g} units"
    words: dict[DriftKind, str] = {
        "constant": f"constant {rest}",
        "sine": f"{rest} + {drift.amplitude:g} {wave}",
        "square": f"{rest} + {drift.amplitude:g} sgn({wave})",
        "ramp": f"ramp from {rest} to {other}, over {drift.span:g} units from {at}",
        "switch": f"switch from {rest} to {other} at {at}"
        + (f", back and forth {again}" if drift.every else ""),
        "burst": f"{rest}, but {other} for {drift.span:g} units from {at}"
        + (f", {again}" if drift.every else ""),
        "random_walk": f"random walk from {rest}, steps of sd {sd}",
        "ou": f"Ornstein-Uhlenbeck around {rest}, pulled by {drift.rate:g} per unit, steps of sd {sd}",
        "noise": f"noise around {rest}, sd {sd}",
        "recorded": f"recorded in `{drift.path}`",
    }
    return words[drift.kind]


def _table(rows: Iterable[tuple[str, str]]) -> str:
    lines = [f"| {name} | {value.replace('|', '/')} |" for name, value in rows]
    return "\n".join(["| | |", "|---|---|", *lines])
