"""The live screen of a run: what a person wants to know four times a second, and no more.

Without a terminal it is one plain line every five seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from statistics import fmean

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from launcher import drawing, fleet_screen, panes
from launcher.drawing import LABEL
from launcher.panes import WIDTH, WORK, Now
from launcher.summary import not_on_disk, passed
from launcher.totals import together
from launcher.watch import Watch
from rtcore import cast, channels
from rtcore.clock import Clock
from rtcore.config import RunConfig

REFRESH_NS = 250_000_000
LINE_NS = 5_000_000_000
LOG_LINES = 5


class Screen:
    """Draws a run; `update` is cheap to call often."""

    def __init__(self, console: Console, config: RunConfig, run: str, watch: Watch, clock: Clock) -> None:
        self._console = console
        self._config = config
        self._run = run
        self._watch = watch
        self._clock = clock
        self._processes = cast.names(config, record=config.recorder.record)
        self._servers = cast.of_role(config, channels.ENV_SERVER)
        self._agents = cast.of_role(config, channels.AGENT)
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
            return "starting: " + ", ".join(fleet_screen.told(now.states))
        count, going_on = len(now.envs), [rate for rate in now.env_rates if rate is not None]
        rate = now.rates[channels.ENV_SERVER] if count == 1 else fmean(going_on) if going_on else None
        held = drawing.number(rate, 1)
        adopted = min(agent.counters["policies.adopted"] for agent in now.agents)  # the slowest's
        parts = [
            drawing.clock(now.run_time_s),
            f"{held} Hz" if count == 1 else f"{count} x {held} Hz",
            f"missed {now.env.counters['missed']}",
            f"loop p99 {drawing.microseconds(now.env.quantiles('loop', 1e-3)['p99'])} µs",
            now.phase,
            f"policy {now.learner.counters['published']}/{adopted}",
            f"{drawing.number(now.rates[channels.LEARNER])} updates/s",
            f"return {drawing.number(now.last_return, 1)}",
        ]
        troubled = [f"{name} {state}" for name, state in now.states.items() if state != "alive"]
        if restarts := self._watch.restarts.total():
            troubled.append(f"restarts {restarts}")
        if now.not_on_disk:
            troubled.append(f"not on disk {now.not_on_disk}")
        return "  ".join(parts + troubled + ([self.note] if self.note else []))

    def render(self) -> RenderableType:
        """The whole screen."""
        now, env = self._read(), self._config.env
        return Panel(
            self._single(now) if env.count == 1 else self._fleet(now),
            title=f"[bold]tenuto[/]  {self._run}",
            subtitle=f"{env.id}  {self._config.learner.algo}  seed {self._config.seed}",
            title_align="left",
            subtitle_align="right",
            border_style=LABEL,
            padding=(0, 1),
            width=min(WIDTH, self._console.width),
        )

    def _single(self, now: Now) -> RenderableType:
        middle = panes.beside(panes.processes(now), panes.deadlines(now, self._config), self._console.width)
        return Group(
            panes.progress(now, self._config, self.note),
            Text(),
            middle,
            Text(),
            panes.learning(now),
            panes.returns(now),
            Text(),
            panes.log(self._watch.events, LOG_LINES),
        )

    def _fleet(self, now: Now) -> RenderableType:
        return fleet_screen.body(
            now,
            self._config,
            self._watch.events,
            note=self.note,
            width=self._console.width,
            shown=fleet_screen.layout(len(self._servers), self._console.height - 1, LOG_LINES),
        )

    def _read(self) -> Now:
        watch = self._watch
        envs = [watch.totals(name) for name in self._servers]
        agents = [watch.totals(name) for name in self._agents]
        env, agent, learner = together(envs), together(agents), watch.totals(channels.LEARNER)
        lacking = not_on_disk([env, agent, learner, watch.totals(channels.RECORDER)])
        run_time_s = max(map(passed, envs)) / (self._config.env.hz or 1.0)
        return Now(
            run_time_s=run_time_s,
            phase=panes.phase(watch.phase(), run_time_s, self._config.env.unit_s),
            states={name: self._state(name) for name in self._processes},
            rates={role: watch.rate(role, counter) for role, (counter, _) in WORK.items()},
            env_rates=[None if watch.ended(name) else watch.rate(name, "ticks") for name in self._servers],
            restarts=watch.restarts,
            envs=envs,
            agents=agents,
            env=env,
            agent=agent,
            learner=learner,
            not_on_disk=sum(lacking.values()),
        )

    def _state(self, process: str) -> str:
        if process in self._watch.down:
            return "down"
        if not self._watch.heard(process):
            return "starting"
        if self._watch.ended(process):
            return "ended"
        return self._watch.health(process, self._clock.now_ns())
