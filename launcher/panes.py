"""The blocks of the live screen, each from what one refresh read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from launcher import drawing
from launcher.drawing import ACCENT, LABEL
from launcher.totals import Totals
from launcher.watch import RETURNS_SHOWN
from rtcore import channels
from rtcore.cast import role_of
from rtcore.config import RunConfig
from rtcore.messages import CAUSES, Event, WindowNotice

WIDTH = 100  # wider gains nothing to read

STATE_STYLE = {
    "alive": "green",
    "late": "yellow",
    "missing": "red",
    "down": "red",
    "starting": LABEL,
    "ended": LABEL,
}
# Of several processes the worst state is told.
WORST_FIRST = ("missing", "down", "late", "starting", "ended", "alive")
LEVEL_STYLE = {"WARN": "yellow", "ERROR": "red"}
# What a process is asked to do, as a rate: the counter and its unit.
WORK = {
    channels.ENV_SERVER: ("ticks", "ticks/s"),
    channels.AGENT: ("actions", "actions/s"),
    channels.LEARNER: ("gradient_steps", "updates/s"),
    channels.RECORDER: ("rows", "rows/s"),
}


@dataclass(frozen=True)
class Now:
    """Everything that one refresh shows, read once.

    Attributes:
        run_time_s: of the environment that is furthest.
        phase: of the learner, in words.
        states: of all processes, in connect order.
        rates: of each role's work (`WORK`), of all its processes together; None: not known yet.
        env_rates: each environment's ticks per second; None: not known yet, or it has ended.
        restarts: of each process.
        envs: each environment's totals.
        agents: each agent's.
        env: those of all environments together.
        agent: of all agents.
        learner: the learner's.
        not_on_disk: what no process's disk took, of every kind.
    """

    run_time_s: float
    phase: str
    states: Mapping[str, str]
    rates: Mapping[str, float | None]
    env_rates: Sequence[float | None]
    restarts: Mapping[str, int]
    envs: Sequence[Totals]
    agents: Sequence[Totals]
    env: Totals
    agent: Totals
    learner: Totals
    not_on_disk: int

    @property
    def last_return(self) -> float | None:
        """Of the newest episode; in a fleet the mean of each environment's."""
        last = [env.returns[-1] for env in self.envs if env.returns]
        return fmean(last) if last else None


def phase(entered: WindowNotice | None, run_time_s: float, unit_s: float) -> str:
    """What the learner is at, in words."""
    if entered is None:
        return "before the first window"
    unit = int(run_time_s / unit_s) - entered.start_unit
    if entered.phase == "hold":
        why = " (operator)" if entered.reason == "operator" else ""
        return f"window {entered.window}, hold{why}"
    g = min(max(unit + 1, 1), entered.update_units)
    return f"window {entered.window}, update {g} of {entered.update_units}"


def progress(now: Now, config: RunConfig, note: str) -> RenderableType:
    """Run time, a bar, and the unit or what the launcher itself is doing."""
    total_s = config.duration_s
    row = Table.grid(padding=(0, 2), expand=True)
    row.add_column(no_wrap=True)
    row.add_column(ratio=1)
    row.add_column(no_wrap=True, justify="right")
    if note or not now.env.counters["ticks"]:
        right = Text(note or "starting", style=ACCENT)
    else:
        right = Text(f"unit {int(now.run_time_s / config.env.unit_s)}", style=LABEL)
    if total_s > 0:
        left = f"{drawing.clock(now.run_time_s)} / {drawing.clock(total_s)}"
        bar: RenderableType = ProgressBar(
            total=total_s,
            completed=min(now.run_time_s, total_s),
            complete_style=ACCENT,
            finished_style=ACCENT,
        )
    else:
        left, bar = drawing.clock(now.run_time_s), Text("until Ctrl-C", style=LABEL)
    row.add_row(left, bar, right)
    return row


def processes(now: Now, padding: int = 2) -> Table:
    """A line for each role: how its processes are, what they do together, how often they were restarted."""
    table = Table.grid(padding=(0, padding))
    table.add_column(style=LABEL, no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    table.add_column(style="yellow", no_wrap=True)
    for role, (_, unit) in WORK.items():
        states = {name: state for name, state in now.states.items() if role_of(name) == role}
        if not states:
            continue
        state, names = worst(states)
        counted = state if len(names) == len(states) else f"{len(names)} {state}"
        rate, restarts = now.rates[role], sum(now.restarts.get(name, 0) for name in states)
        shown = drawing.number(rate, 0 if rate is not None and rate >= 1000 else 1)
        again = f"↻ {restarts}" if restarts else ""
        table.add_row(role, Text(f"● {counted}", style=STATE_STYLE[state]), f"{shown} {unit}", again)
    return table


def worst(states: Mapping[str, str]) -> tuple[str, list[str]]:
    """The worst state and who is in it."""
    state = min(states.values(), key=WORST_FIRST.index)
    return state, [name for name, its in states.items() if its == state]


def deadlines(now: Now, config: RunConfig) -> RenderableType:
    """One environment's rate, misses and latencies."""
    ticks, missed = now.env.counters["ticks"], now.env.counters["missed"]
    held = drawing.number(now.rates[channels.ENV_SERVER], 1)
    facts = drawing.pairs(
        [
            ("rate held", f"{held} of {drawing.number(config.env.hz, 1)} Hz"),
            ("missed", drawing.misses(missed, missed / ticks if ticks else None)),
            ("", causes(now)),
        ]
    )
    return Group(facts, drawing.latencies(latencies(now)))


def causes(now: Now) -> Text:
    """What most misses are due to."""
    by_cause: dict[str, int] = {cause: now.env.counters[f"missed.{cause}"] for cause in CAUSES}
    return drawing.causes(by_cause, limit=2)


def latencies(now: Now) -> dict[str, dict[str, float | None]]:
    """Of all environments and agents, for `drawing.latencies`."""
    return {
        "pacing": now.env.quantiles("pacing", 1e-3),
        "loop": now.env.quantiles("loop", 1e-3),
        "reaction": now.agent.quantiles("reaction", 1e-3),
    }


def learning(now: Now) -> RenderableType:
    """Where learning stands."""
    published, adopted = now.learner.counters["published"], now.agent.counters["policies.adopted"]
    replay = now.learner.gauges.get("replay_size", 0.0)
    steps = now.learner.counters["gradient_steps"]
    return Columns(
        [
            drawing.pairs([("phase", now.phase), ("replay", f"{replay:,.0f} transitions")]),
            drawing.pairs(
                [("policy", f"{published} published, {adopted} adopted"), ("updates", f"{steps:,}")]
            ),
        ],
        padding=(0, 4),
    )


def returns(now: Now) -> RenderableType:
    """One environment's newest returns."""
    found = now.env.returns
    last = f"last {drawing.number(found[-1], 1)}   best {drawing.number(max(found), 1)}" if found else ""
    spark = Text(drawing.sparkline(found, RETURNS_SHOWN), style=ACCENT)
    return drawing.pairs([("return", Text.assemble(spark, "  ", last))])


def log(events: Iterable[tuple[str, Event]], lines: int) -> RenderableType:
    """What the processes said last."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style=LABEL, no_wrap=True)
    table.add_column(no_wrap=True, overflow="ellipsis")
    recent = list(events)[-lines:]
    for process, event in recent:
        table.add_row(process, Text(event.text.replace("\n", " "), style=LEVEL_STYLE.get(event.level, LABEL)))
    for _ in range(lines - len(recent)):  # a screen that keeps its height is a calm one
        table.add_row("", "")
    return table


def beside(left: RenderableType, right: RenderableType, width: int) -> Table:
    """Two blocks side by side, on a screen of so many columns."""
    table = Table.grid(padding=(0, 4) if width >= WIDTH else (0, 2))
    table.add_row(left, right)
    return table
