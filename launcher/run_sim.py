"""`tenuto sim`: a run in virtual time, in this one process."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from launcher import options, regret, report
from launcher.cli import DONE, FAILED
from launcher.drawing import clock
from launcher.run import default_path, keep_summary
from launcher.streams import dispensable
from launcher.summary import summarise
from rtcore.config import ConfigError, RunConfig
from rtcore.lifecycle import Stop, stop_on_signals
from rtcore.run_dir import RunDir


def run_sim(argv: Sequence[str]) -> int:
    """`tenuto sim [PRESET] ...`."""
    description = options.describe("Learn in virtual time: deterministic, as fast as this machine goes.")
    config, chosen = options.read(options.RunOptions, argv, prog="tenuto sim", description=description)
    if config.duration_s == 0:
        raise ConfigError("duration_s", 0, "must be above 0 in virtual time")
    run_dir = RunDir.create(chosen.run_dir or default_path(config), config)
    with dispensable():
        return _run(config, run_dir)


def _run(config: RunConfig, run_dir: RunDir) -> int:
    """To the report."""
    from launcher.sim import simulate  # with it comes all that is heavy: only now

    console, stop = Console(), Stop()
    console.print(f"run  {run_dir.path}", highlight=False, soft_wrap=True)
    with stop_on_signals(stop), _progress(console, config) as progress:
        stats, wall_s = simulate(config, run_dir, stop, progress)
    summary = summarise(
        config,
        run_dir.run_name,
        stats,
        wall_s=wall_s,
        restarts={},
        ended="interrupted" if stop.is_set() else "duration",
        clock="virtual",
    )
    summary |= regret.of_run(config, run_dir)
    kept = keep_summary(summary, run_dir)
    console.print(report.render(summary, run_dir))
    return DONE if kept else FAILED


@contextmanager
def _progress(console: Console, config: RunConfig) -> Iterator[Callable[[float], None]]:
    """A bar of the run time; without a terminal, a line every tenth of the run."""
    if not console.is_terminal:
        yield _lines(console, config.duration_s)
        return
    columns = (TextColumn("{task.fields[at]}"), BarColumn(bar_width=None), TimeRemainingColumn())
    with Progress(*columns, console=console, refresh_per_second=4, transient=True) as bar:
        task = bar.add_task("", total=config.duration_s, at="")

        def show(run_time_s: float) -> None:
            bar.update(
                task, completed=run_time_s, at=f"{clock(run_time_s)} / {clock(config.duration_s)} of run time"
            )

        yield show


def _lines(console: Console, duration_s: float) -> Callable[[float], None]:
    tenths = 0

    def show(run_time_s: float) -> None:
        nonlocal tenths
        now = int(10 * run_time_s / duration_s)
        if now > tenths:
            tenths = now
            console.print(f"{10 * tenths:3} %  {clock(run_time_s)} of run time", highlight=False)

    return show
