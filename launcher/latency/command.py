"""`tenuto latency`: the real-time test of this machine, with the real system and bare echoes beside it."""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from launcher import presets
from launcher.cli import DONE, CommandError
from launcher.drawing import clock
from launcher.echo.links import Transport
from launcher.echo.measure import EchoError, EchoResult, measure_echo
from launcher.latency.hold_rate import LADDER_HZ, LIMIT, Counted, Search, search, statement
from launcher.latency.results import SETTLED_S, Cell, Results, as_json
from launcher.latency.table import ECHOES, LOADS, cell_table, overview, remarks
from launcher.latency.trial import Load, Trial, trial_config
from launcher.latency.trial_run import TrialError, run_trial
from launcher.machine import machine
from launcher.out_dir import make_out_dir
from launcher.parsing import parse
from launcher.run import RUNS
from rtcore.config import ConfigError, RunConfig
from rtcore.files import write_atomic
from rtcore.realtime import Rt
from rtcore.run_dir import default_run_path

RATES_HZ = (100.0, 200.0, 500.0, 1000.0)
REFRESH_S = 1.0  # of the progress bar: drawing it costs a millisecond on the machine that is measured
OVERHEAD_S = 4.0  # about: until the processes of one measurement tick, and until they have ended


@dataclass(frozen=True, kw_only=True)
class LatencyOptions:
    """Measure pacing, reaction and loop of the real system, beside a bare echo, at several rates."""

    hz: str | None = None
    """Rates in Hz, separated by commas. None: 100,200,500,1000; with --hold-rate: 100 to 4000."""
    load: Literal["none", "learner", "both"] = "both"
    """Without and with a learner that takes all it is given. --hold-rate takes the learner for both."""
    seconds: float = 20.0
    """How long each measurement lasts: the system, the Zenoh echo, the unix-socket echo."""
    env: str = "pointmass"
    """The preset whose world and learner are run."""
    rt: Rt = "auto"
    """Real-time scheduling, as agent.rt."""
    record: bool = False
    """Run the recorder, too."""
    hold_rate: bool = False
    """Find the highest rate that keeps the miss ratio under a limit, instead."""
    limit: float = LIMIT
    """That limit. 1e-4 takes 30 000 ticks without a miss to show."""
    out: Path | None = None
    """Directory for latency.json and latency.png; it must not exist yet. None: runs/<utc>-latency."""


@dataclass(frozen=True)
class Plan:
    """The options, checked: what is to be measured."""

    options: LatencyOptions
    base: RunConfig
    rates: tuple[float, ...]
    loads: tuple[Load, ...]

    def config(self, hz: float, load: Load, seconds: float) -> RunConfig:
        """The run behind one trial."""
        chosen = self.options
        return trial_config(self.base, hz=hz, load=load, seconds=seconds, rt=chosen.rt, record=chosen.record)


def latency(argv: Sequence[str]) -> int:
    """`tenuto latency`."""
    options = parse(LatencyOptions, argv, prog="tenuto latency", description=str(LatencyOptions.__doc__))
    planned = plan(options)
    out = options.out or default_run_path(RUNS, "latency", datetime.now(UTC))
    made = make_out_dir(out)
    console = Console()
    results = Results(
        at=datetime.now(UTC).isoformat(timespec="seconds"),
        machine=machine(),
        options={
            "hz": planned.rates, "load": options.load, "seconds": options.seconds, "env": options.env,
            "rt": options.rt, "record": options.record,
        },
    )  # fmt: skip
    failure = None
    with _terminated_like_interrupted(), _progress(console) as progress:
        try:
            if options.hold_rate:
                _hold_rate(planned, results, console, progress)
            else:
                _measure_all(planned, results, console, progress)
        except KeyboardInterrupt:
            results.interrupted = True
        except (EchoError, TrialError) as error:
            failure = error
    if not results.cells and not (results.search and results.search.attempts):
        for path in made:
            with suppress(OSError):  # somebody else uses it by now
                path.rmdir()
        raise CommandError("interrupted before anything was measured" if failure is None else str(failure))
    _finish(results, out, console)
    if failure is not None:
        raise CommandError(str(failure)) from failure
    return DONE


def plan(options: LatencyOptions) -> Plan:
    """Check everything before anything starts.

    Raises:
        ConfigError: an option is wrong, or the preset cannot be run at one of the rates.
    """
    if not (math.isfinite(options.seconds) and options.seconds > SETTLED_S):
        raise ConfigError("seconds", options.seconds, f"must be above {SETTLED_S:g}: the first is a warm-up")
    if not 0 < options.limit < 1:
        raise ConfigError("limit", options.limit, "must be in (0, 1)")
    default = tuple(map(float, LADDER_HZ)) if options.hold_rate else RATES_HZ
    rates = default if options.hz is None else parse_rates(options.hz)
    loads: tuple[Load, ...] = ("none", "learner") if options.load == "both" else (options.load,)
    base = presets.load(options.env)
    if base.env.count > 1:  # what is measured is one pair of env server and agent
        allowed = f"must be a preset of one environment: its env.count is {base.env.count}"
        raise ConfigError("env", options.env, allowed)
    planned = Plan(options, base, rates, loads)
    for hz in rates:
        planned.config(hz, loads[0], options.seconds)
    return planned


def parse_rates(text: str) -> tuple[float, ...]:
    """Rising rates, each once, from what was typed.

    Raises:
        ConfigError: it is not numbers with commas in between.
    """
    try:
        rates = sorted({float(part) for part in text.split(",")})
    except ValueError:
        rates = []
    if not rates or not all(0 < rate < math.inf for rate in rates):
        raise ConfigError("hz", text, "must be rates in Hz, separated by commas, like 100,500,1000")
    return tuple(rates)


Step = Callable[[str, float], Callable[[], None]]  # (what is measured now, seconds) -> on_poll


def _measure_all(planned: Plan, results: Results, console: Console, step: Step) -> None:
    """Each rate under each load: the system, then the echoes, in the same minute."""
    seconds, rt = planned.options.seconds, planned.options.rt
    count = len(planned.rates) * len(planned.loads)
    each_s = (1 + len(ECHOES)) * (seconds + OVERHEAD_S)
    conditions = "1 condition" if count == 1 else f"{count} conditions"
    console.print(f"{conditions}, about {clock(count * each_s)} in all; Ctrl-C keeps what is there\n")
    for hz in planned.rates:
        for load in planned.loads:
            what = f"{hz:g} Hz, {LOADS[load]}"
            on_poll = step(f"{what}: the system", seconds)
            trial = run_trial(planned.config(hz, load, seconds), load, on_poll)
            if not trial.ticks:
                raise KeyboardInterrupt
            cell = Cell(hz, load, trial)
            results.cells.append(cell)
            try:
                if trial.interrupted:
                    raise KeyboardInterrupt
                for transport, name in ECHOES.items():
                    cell.echoes[transport] = _echo(
                        transport, hz, seconds, rt, load, step(f"{what}: {name}", seconds)
                    )
            finally:
                console.print(cell_table(cell))
                for remark in remarks(cell):
                    console.print(f"  {remark}", highlight=False)
                console.print()


def _echo(
    transport: Transport, hz: float, seconds: float, rt: Rt, load: Load, on_poll: Callable[[], None]
) -> EchoResult:
    return measure_echo(transport, hz=hz, seconds=seconds, rt=rt, load=load == "learner", on_poll=on_poll)


def _hold_rate(planned: Plan, results: Results, console: Console, step: Step) -> None:
    """Search, with the heaviest of the loads that were asked for."""
    load = planned.loads[-1]
    console.print(
        f"the highest of {', '.join(f'{hz:g}' for hz in planned.rates)} Hz with a miss ratio under"
        f" {planned.options.limit:g}, {LOADS[load]}; Ctrl-C keeps what is there\n",
        highlight=False,
    )
    results.search = found = Search(limit=planned.options.limit)

    def measure(hz: float, seconds: float) -> Counted:
        stage = f"{hz:g} Hz, {LOADS[load]}"
        config = planned.config(hz, load, seconds + SETTLED_S)
        trial = run_trial(config, load, step(stage, seconds + SETTLED_S))
        if trial.interrupted:
            raise KeyboardInterrupt
        counted = judged(trial, seconds + SETTLED_S)
        console.print(f"{hz:>6g} Hz  {counted.missed} of {counted.ticks:,} missed", highlight=False)
        return counted

    search(measure, planned.rates, found)


def judged(trial: Trial, seconds: float) -> Counted:
    """The deadlines of a trial of `seconds` after its first second; one that an overrun lost is a miss."""
    deadlines = round(seconds * trial.hz) - math.ceil(SETTLED_S * trial.hz)
    ticks, missed = trial.since(SETTLED_S)
    return Counted(deadlines, missed + deadlines - ticks)


def _finish(results: Results, out: Path, console: Console) -> None:
    """Write what there is, and say where."""
    if len(results.cells) > 1:
        console.print(overview(results.cells))
    if results.search is not None:
        console.print("\n" + "\n".join(statement(results.search)), highlight=False)
    write_atomic(out / "latency.json", (json.dumps(as_json(results), indent=2) + "\n").encode())
    console.print(f"\nresults  {out / 'latency.json'}", highlight=False, soft_wrap=True)
    if results.cells:
        from launcher.latency.picture import draw  # a second, and memory, that no measurement should see

        draw(results, out / "latency.png")
        console.print(f"picture  {out / 'latency.png'}", highlight=False, soft_wrap=True)


@contextmanager
def _progress(console: Console) -> Iterator[Step]:
    """A bar for the measurement under way; without a terminal, a line for each."""
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=console,
        auto_refresh=False, transient=True,
    )  # fmt: skip
    task = bar.add_task("", total=None)

    def step(what: str, seconds: float) -> Callable[[], None]:
        began = shown = time.monotonic()
        bar.reset(task, description=what, total=seconds + OVERHEAD_S)
        if not console.is_terminal:
            console.print(what, highlight=False)

        def on_poll() -> None:
            nonlocal shown
            now = time.monotonic()
            if now - shown >= REFRESH_S:
                shown = now
                bar.update(task, completed=min(now - began, seconds + OVERHEAD_S), refresh=True)

        return on_poll

    if not console.is_terminal:
        yield step
        return
    with bar:
        yield step


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """Inside the block SIGTERM does what Ctrl-C does."""
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
