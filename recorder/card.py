"""The run card: what this recording is of, as a page of text inside it. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict

from rtcore.config import DriftConfig, LearnerConfig, RunConfig, ScheduleConfig
from rtcore.messages import Spec


def run_card(run: str, config: RunConfig, spec: Spec, placements: Mapping[str, str]) -> str:
    """Markdown. `placements` says per process what the system granted it."""
    learner = config.learner
    world = [
        ("environment", f"`{spec.env_id}` ({spec.observation_dim} observations, {spec.action_dim} actions)"),
        ("rate", _rate(spec)),
        ("episode", f"{config.env.episode_steps} ticks"),
        ("unit t", f"{spec.unit_ns / 1e9:g} s"),
        ("drift", _drift(config.env.drift)),
        ("action delay", f"{spec.action_delay_ticks} ticks"),
        ("on a miss", config.env.on_miss),
    ]
    student = [
        ("algorithm", f"`{learner.algo}`, hidden {list(learner.hidden)}, batch {learner.batch}"),
        (
            "learning rate",
            f"actor {learner.actor_lr:g}, critic {learner.critic_lr:g}, gamma {learner.gamma:g}",
        ),
        ("updates", f"at most {learner.utd:g} per transition, from {learner.learning_starts} transitions on"),
        ("schedule", _schedule(learner.schedule)),
        ("in the hold", f"critics learn: {learner.hold_learning}"),
        ("forecast", _forecast(learner)),
    ]
    duration = f"{config.duration_s:g} s" if config.duration_s else "until stopped"
    head = [("preset", f"`{config.preset}`"), ("seed", str(config.seed)), ("duration", duration)]
    page = [f"# {run}", _table(head), "## World", _table(world), "## Learner", _table(student)]
    if placements:
        page += ["## Placement", _table(sorted(placements.items()))]
    return "\n\n".join(page) + "\n"


def _rate(spec: Spec) -> str:
    rate = f"{1e9 / spec.tick_ns:g} Hz, so a deadline every {spec.tick_ns / 1e6:g} ms"
    if spec.native_period_ns == 0:
        return rate
    return f"{rate}; {spec.native_period_ns / spec.tick_ns:g} x native speed"


def _drift(drift: DriftConfig) -> str:
    match drift.kind:
        case "none":
            return "none"
        case "constant":
            return f"constant {drift.offset:g}"
        case "sine":
            phase = f" + {drift.phase:g}" if drift.phase else ""
            return f"{drift.offset:g} + {drift.amplitude:g} sin({drift.omega:g} t{phase})"
        case _:
            plain, given = asdict(DriftConfig(kind=drift.kind)), asdict(drift)
            return ", ".join(
                [drift.kind, *(f"{name} {value}" for name, value in given.items() if value != plain[name])]
            )


def _schedule(schedule: ScheduleConfig) -> str:
    match schedule.kind:
        case "fixed":
            share = f"{schedule.gamma_f:g} ({schedule.rounding}) of each for updates"
            return f"fixed: windows of {schedule.l_f} units, {share}"
        case "explicit":
            return f"explicit: starts {list(schedule.t_m)}, updates {list(schedule.g_m)} units"


def _forecast(learner: LearnerConfig) -> str:
    forecast = learner.forecast
    if learner.algo == "sac" or forecast.kind == "none":
        return "none"
    words = {"window": "the window", "replay": "the window and the replay's age"}
    horizon = words.get(str(forecast.horizon)) or f"{forecast.horizon} units"
    return f"{forecast.kind}, {forecast.l_p} past critics, basis {forecast.basis}, horizon {horizon}"


def _table(rows: Iterable[tuple[str, str]]) -> str:
    lines = [f"| {name} | {value.replace('|', '/')} |" for name, value in rows]
    return "\n".join(["| | |", "|---|---|", *lines])
