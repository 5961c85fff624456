"""The live screen of a run: what a person wants to know four times a second, and no more.

Without a terminal it is one plain line every five seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from launcher import drawing
from launcher.drawing import ACCENT, LABEL
from launcher.summary import PASSED, Totals
from launcher.watch import RETURNS_SHOWN, Watch
from rtcore import channels
from rtcore.clock import Clock
from rtcore.config import RunConfig
from rtcore.messages import CAUSES

REFRESH_NS = 250_000_000
LINE_NS = 5_000_000_000
LOG_LINES = 5
WIDTH = 100  # wider gains nothing to read

STATE_STYLE = {
    "alive": "green",
    "late": "yellow",
    "missing": "red",
    "down": "red",
    "starting": LABEL,
    "ended": LABEL,
}
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
    """Everything that one refresh shows, read once."""

    run_time_s: float
    env: Totals
    agent: Totals
    learner: Totals


class Screen:
    """Draws a run; `update` is cheap to call often."""

    def __init__(self, console: Console, config: RunConfig, run: str, watch: Watch, clock: Clock) -> None:
        self._console = console
        self._config = config
        self._run = run
        self._watch = watch
        self._clock = clock
        self._processes = [
            name for name in channels.PROCESSES if name != channels.RECORDER or config.recorder.record
        ]
        self._live: Live | None = None
        self._due_ns = clock.now_ns()
        self.note = ""  # what the launcher itself is doing

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show the screen inside the block; nothing of it stays."""
        if not self._console.is_terminal:
            yield
            return
        with Live(console=self._console, auto_refresh=False, transient=True) as live:
            self._live = live
            try:
                yield
            finally:
                self._live = None

    def update(self) -> None:
        """Draw if it is time."""
        now_ns = self._clock.now_ns()
        if now_ns < self._due_ns:
            return
        if self._live is None:
            self._due_ns = now_ns + LINE_NS
            self._console.print(self.line(), highlight=False, soft_wrap=True)
        else:
            self._due_ns = now_ns + REFRESH_NS
            self._live.update(self.render(), refresh=True)

    def say(self, text: str) -> None:
        """Print a line that stays, above the screen."""
        self._console.print(text, highlight=False, soft_wrap=True)

    def line(self) -> str:
        """The state in one line."""
        now = self._read()
        if not now.env.counters["ticks"]:
            return "starting: " + ", ".join(f"{name} {self._state(name)}" for name in self._processes)
        parts = [
            drawing.clock(now.run_time_s),
            f"{drawing.number(self._watch.rate(channels.ENV_SERVER, 'ticks'), 1)} Hz",
            f"missed {now.env.counters['missed']}",
            f"loop p99 {drawing.microseconds(now.env.quantiles('loop', 1e-3)['p99'])} µs",
            self._phase(now.run_time_s),
            f"policy {now.learner.counters['published']}/{now.agent.counters['policies.adopted']}",
            f"{drawing.number(self._watch.rate(channels.LEARNER, 'gradient_steps'))} updates/s",
            f"return {drawing.number(now.env.returns[-1], 1) if now.env.returns else '·'}",
        ]
        troubled = [f"{name} {state}" for name in self._processes if (state := self._state(name)) != "alive"]
        if restarts := self._watch.restarts.total():
            troubled.append(f"restarts {restarts}")
        return "  ".join(parts + troubled + ([self.note] if self.note else []))

    def render(self) -> RenderableType:
        """The whole screen."""
        now = self._read()
        middle = Table.grid(padding=(0, 4) if self._console.width >= WIDTH else (0, 2))
        middle.add_row(self._processes_table(), self._deadlines(now))
        body = Group(self._progress(now), Text(), middle, Text(), self._learning(now), Text(), self._log())
        env = self._config.env
        return Panel(
            body,
            title=f"[bold]tenuto[/]  {self._run}",
            subtitle=f"{env.id}  {self._config.learner.algo}  seed {self._config.seed}",
            title_align="left",
            subtitle_align="right",
            border_style=LABEL,
            padding=(0, 1),
            width=min(WIDTH, self._console.width),
        )

    def _read(self) -> Now:
        env = self._watch.totals(channels.ENV_SERVER)
        passed = sum(env.counters[name] for name in PASSED)
        return Now(
            passed / (self._config.env.hz or 1.0),
            env,
            self._watch.totals(channels.AGENT),
            self._watch.totals(channels.LEARNER),
        )

    def _state(self, process: str) -> str:
        if process in self._watch.down:
            return "down"
        if not self._watch.heard(process):
            return "starting"
        if self._watch.ended(process):
            return "ended"
        return self._watch.health(process, self._clock.now_ns())

    def _progress(self, now: Now) -> RenderableType:
        total_s = self._config.duration_s
        row = Table.grid(padding=(0, 2), expand=True)
        row.add_column(no_wrap=True)
        row.add_column(ratio=1)
        row.add_column(no_wrap=True, justify="right")
        if self.note or not now.env.counters["ticks"]:
            right = Text(self.note or "starting", style=ACCENT)
        else:
            unit = int(now.run_time_s / self._config.env.unit_s)
            right = Text(f"unit {unit}", style=LABEL)
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

    def _processes_table(self) -> Table:
        table = Table.grid(padding=(0, 2))
        table.add_column(style=LABEL, no_wrap=True)
        table.add_column(no_wrap=True)
        table.add_column(justify="right", no_wrap=True)
        table.add_column(style="yellow", no_wrap=True)
        for process in self._processes:
            counter, unit = WORK[process]
            state = self._state(process)
            rate = self._watch.rate(process, counter)
            shown = drawing.number(rate, 0 if rate is not None and rate >= 1000 else 1)
            restarts = self._watch.restarts[process]
            again = f"↻ {restarts}" if restarts else ""
            table.add_row(process, Text(f"● {state}", style=STATE_STYLE[state]), f"{shown} {unit}", again)
        return table

    def _deadlines(self, now: Now) -> RenderableType:
        ticks, missed = now.env.counters["ticks"], now.env.counters["missed"]
        by_cause: dict[str, int] = {cause: now.env.counters[f"missed.{cause}"] for cause in CAUSES}
        held = drawing.number(self._watch.rate(channels.ENV_SERVER, "ticks"), 1)
        facts = drawing.pairs(
            [
                ("rate held", f"{held} of {drawing.number(self._config.env.hz, 1)} Hz"),
                ("missed", drawing.misses(missed, missed / ticks if ticks else None)),
                ("", drawing.causes(by_cause, limit=2)),
            ]
        )
        times = drawing.latencies(
            {
                "pacing": now.env.quantiles("pacing", 1e-3),
                "loop": now.env.quantiles("loop", 1e-3),
                "reaction": now.agent.quantiles("reaction", 1e-3),
            }
        )
        return Group(facts, times)

    def _learning(self, now: Now) -> RenderableType:
        published, adopted = now.learner.counters["published"], now.agent.counters["policies.adopted"]
        replay = now.learner.gauges.get("replay_size", 0.0)
        steps = now.learner.counters["gradient_steps"]
        returns = now.env.returns
        facts = Columns(
            [
                drawing.pairs(
                    [("phase", self._phase(now.run_time_s)), ("replay", f"{replay:,.0f} transitions")]
                ),
                drawing.pairs(
                    [("policy", f"{published} published, {adopted} adopted"), ("updates", f"{steps:,}")]
                ),
            ],
            padding=(0, 4),
        )
        last = (
            f"last {drawing.number(returns[-1], 1)}   best {drawing.number(max(returns), 1)}"
            if returns
            else ""
        )
        spark = Text(drawing.sparkline(returns, RETURNS_SHOWN), style=ACCENT)
        return Group(facts, drawing.pairs([("return", Text.assemble(spark, "  ", last))]))

    def _phase(self, run_time_s: float) -> str:
        entered = self._watch.phase()
        if entered is None:
            return "before the first window"
        unit = int(run_time_s / self._config.env.unit_s) - entered.start_unit
        if entered.phase == "hold":
            why = " (operator)" if entered.reason == "operator" else ""
            return f"window {entered.window}, hold{why}"
        g = min(max(unit + 1, 1), entered.update_units)
        return f"window {entered.window}, update {g} of {entered.update_units}"

    def _log(self) -> RenderableType:
        table = Table.grid(padding=(0, 2))
        table.add_column(style=LABEL, no_wrap=True)
        table.add_column(no_wrap=True, overflow="ellipsis")
        recent = list(self._watch.events)[-LOG_LINES:]
        for process, event in recent:
            table.add_row(
                process, Text(event.text.replace("\n", " "), style=LEVEL_STYLE.get(event.level, LABEL))
            )
        for _ in range(LOG_LINES - len(recent)):  # a screen that keeps its height is a calm one
            table.add_row("", "")
        return table
