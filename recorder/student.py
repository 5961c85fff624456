"""The run card's rows on the learner: only what its algorithm goes by. Pure."""

from __future__ import annotations

from rtcore.config import ForecastConfig, LearnerConfig, RewardModelConfig, ScheduleConfig

Row = tuple[str, str]


def student_rows(learner: LearnerConfig) -> list[Row]:
    """Name and value of each, in the order in which they are read."""
    schedule = ("schedule", _schedule(learner.schedule))
    match learner.algo:
        case "tempo":
            return [("algorithm", _tempo(learner)), schedule]
        case "q" | "fq" | "npg":
            return [*_table(learner), schedule, *_hold(learner, "Q learns"), *_forecast(learner)]
        case "sac" | "fsac" | "rsac":
            return [*_network(learner), schedule, *_hold(learner, "critics learn"), *_forecast(learner)]


def _network(learner: LearnerConfig) -> list[Row]:
    rates = f"actor {learner.actor_lr:g}, critic {learner.critic_lr:g}, gamma {learner.gamma:g}"
    return [
        ("algorithm", f"`{learner.algo}`, hidden {list(learner.hidden)}, batch {learner.batch}"),
        ("learning rate", rates),
        ("updates", f"at most {learner.utd:g} per transition, from {learner.learning_starts} transitions on"),
    ]


def _table(learner: LearnerConfig) -> list[Row]:
    table = learner.table
    rows = [
        ("algorithm", f"`{learner.algo}`, in a table"),
        ("step size", f"{table.step_size:g}, gamma {learner.gamma:g}"),
        ("random actions", f"{100 * table.epsilon:g} %"),
    ]
    if learner.algo == "npg":
        rows.append(("policy's step", f"eta {table.eta:g}, weight of the entropy {table.entropy:g}"))
    return rows


def _tempo(learner: LearnerConfig) -> str:
    begin, span = learner.table.tempo_begin, learner.table.tempo_span
    rise = f"rises from 0 in unit {begin} to 1 in unit {begin + span}"
    return f"`tempo`, which learns nothing: the probability of action 0 {rise}"


def _schedule(schedule: ScheduleConfig) -> str:
    match schedule.kind:
        case "fixed":
            length = f"{schedule.l_f} unit{'s' if schedule.l_f > 1 else ''}"
            share = f"{schedule.gamma_f:g} ({schedule.rounding}) of each for updates"
            return f"fixed: windows of {length}, {share if _holds(schedule) else 'without a hold'}"
        case "explicit":
            return f"explicit: starts {list(schedule.t_m)}, updates {list(schedule.g_m)} units"
        case "live":
            return "live: a window of 1 unit after the other, without a hold"
        case "optimal":
            return f"optimal: windows of {schedule.l_f} units, held as the bound of given constants has it"
        case "auto":
            return f"auto: windows of {schedule.l_f} units, held as forecasts predict it to pay"
        case "auto_bound":
            return f"auto_bound: windows of {schedule.l_f} units, held as the bound of live estimates has it"


def _holds(schedule: ScheduleConfig) -> bool:
    match schedule.kind:
        case "fixed":
            return schedule.gamma_f < 1 and schedule.l_f > 1
        case kind:
            return kind != "live"


def _hold(learner: LearnerConfig, who: str) -> list[Row]:
    if not _holds(learner.schedule):
        return []
    return [("in the hold", f"{who}: {learner.hold_learning}")]


def _forecast(learner: LearnerConfig) -> list[Row]:
    match learner.algo:
        case "fq" | "npg":
            return [("forecast", _of_q(learner.forecast, "tables"))]
        case "fsac":
            return [("forecast", _of_q(learner.forecast, "critics"))]
        case "rsac":
            return [("forecast", _of_reward(learner.reward))]
        case _:
            return [("forecast", "none")]


def _of_q(forecast: ForecastConfig, past: str) -> str:
    if forecast.kind == "none":
        return "none"
    words = {"window": "the window", "replay": "the window and the replay's age"}
    horizon = words.get(str(forecast.horizon)) or f"{forecast.horizon} units"
    trust = "" if forecast.trust == "always" else f", trusted: {forecast.trust}"
    return f"{forecast.kind}, {forecast.l_p} past {past}, basis {forecast.basis}, horizon {horizon}{trust}"


def _of_reward(model: RewardModelConfig) -> str:
    family = "of a learned family" if model.model == "learned" else "of the declared family"
    return f"of the reward, which is {family}: its drift by {model.forecast}"
