"""Carrying out a trial: a run in a temporary directory, read tick by tick.

The run is `tenuto run`, as a user starts it. A reader of the lossless log stands where the recorder would
and keeps of every tick what the summary's histograms cannot tell: when it was.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from launcher.latency.trial import Load, Series, Trial
from launcher.stealing import StealMeter
from rtcore import channels
from rtcore.config import RunConfig
from rtcore.config_io import dump_toml
from rtcore.lifecycle import Stop
from rtcore.log_reader import LogReader
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import open_bus

READER_NICENESS = 10  # reading is never worth a missed deadline
READER_BATCHES = 4000  # 200 s of log, should the reader be kept waiting
POLL_S = 0.1
END_LIMIT_S = 8.0  # for an interrupted run, which takes 5 s at most
TAIL_LINES = 2


class TrialError(RuntimeError):
    """The run failed."""


def run_trial(config: RunConfig, load: Load, on_poll: Callable[[], None] = lambda: None) -> Trial:
    """Run `config` for its duration and read its log. Ctrl-C ends the run in order; the trial then says so.

    Args:
        config: from `trial_config`.
        load: which load that is.
        on_poll: called ten times a second meanwhile.

    Raises:
        TrialError: the run failed.
    """
    with tempfile.TemporaryDirectory(prefix="tenuto-trial-") as name:
        file, path = Path(name) / "config.toml", Path(name) / "run"
        file.write_text(dump_toml(config))
        series, interrupted, steal = Series(), False, StealMeter()
        began = time.monotonic()
        with _tenuto_run(file, path) as run, _reading(path, config.env.name, series):
            try:
                while run.poll() is None:
                    on_poll()
                    time.sleep(POLL_S)
            except KeyboardInterrupt:
                interrupted = True
                run.send_signal(signal.SIGINT)
                with contextlib.suppress(subprocess.TimeoutExpired):  # then it is killed, and that is told
                    run.wait(END_LIMIT_S)
        span_s = time.monotonic() - began
        if run.returncode:
            raise TrialError(_last_words(Path(name) / "output") or f"exit code {run.returncode}")
        return _gather(config, load, path, series, steal.elapsed_s(), span_s, interrupted=interrupted)


@contextmanager
def _tenuto_run(config: Path, path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`tenuto run`, in a process group of its own: the terminal's Ctrl-C is passed on, not shared."""
    with (path.parent / "output").open("wb") as output:
        run = subprocess.Popen(
            [sys.executable, "-m", "launcher", "run", "--config", str(config), "--run-dir", str(path)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            process_group=0,
        )
    try:
        yield run
    finally:
        if run.poll() is None:
            run.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                run.wait(END_LIMIT_S)
            run.kill()
            run.wait()


@contextmanager
def _reading(path: Path, env: str, series: Series) -> Iterator[None]:
    """Read the run's log into `series` on a thread, as long as the block runs and until its end is read."""
    stop = Stop()
    thread = threading.Thread(target=_read, args=(path, env, series, stop), name="log reader")
    thread.start()
    try:
        yield
    finally:
        stop.set("the run has ended")
        thread.join()


def _read(path: Path, env: str, series: Series, stop: Stop) -> None:
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), READER_NICENESS)  # Zenoh's threads inherit
    while not RunDir(path).config_path.is_file():
        if stop.wait(POLL_S):
            return
    run_dir, clock = RunDir.open(path), MonotonicClock()
    with open_bus("client", run_dir.run_name, run_dir.socket_dir(), clock=clock) as bus:
        reader = LogReader(bus, env, capacity_batches=READER_BATCHES)
        while not reader.ended and not stop.wait(POLL_S):
            series.add(reader.read(clock.now_ns()))
        series.add(reader.read(clock.now_ns()))
        series.add(reader.finish())


def _gather(
    config: RunConfig,
    load: Load,
    path: Path,
    series: Series,
    steal_s: float | None,
    span_s: float,
    *,
    interrupted: bool,
) -> Trial:
    run_dir = RunDir(path)
    summary: dict[str, Any] = json.loads(run_dir.summary_path.read_text())
    deadlines = summary["deadlines"]
    return Trial(
        hz=config.env.hz or 0.0,
        load=load,
        rt=config.agent.rt,
        ticks=summary["ticks"],
        missed=deadlines["missed"],
        overruns=deadlines["overruns"],
        skipped=deadlines["skipped"],
        causes={cause: count for cause, count in deadlines["missed_by_cause"].items() if count},
        updates_per_s=summary["learner"]["updates_per_s"],
        placement={
            process: _placement(run_dir, process) for process in (channels.ENV_SERVER, channels.AGENT)
        },
        tick=np.array(series.tick, np.int64),
        pacing_ns=np.array(series.pacing_ns, np.int64),
        loop_ns=np.array(series.loop_ns, np.int64),
        reaction_ns=np.array(series.reaction_ns, np.int64),
        was_missed=np.array(series.missed, np.bool_),
        steal_s=steal_s,
        span_s=span_s,
        interrupted=interrupted,
    )


def _placement(run_dir: RunDir, process: str) -> str:
    """What a process said about its place, from its log; empty if it said nothing."""
    path = run_dir.log_path(process)
    for line in path.read_text().splitlines() if path.exists() else ():
        text: str = json.loads(line)["text"]
        if text.startswith(f"{process}: "):
            return text.removeprefix(f"{process}: ")
    return ""


def _last_words(output: Path) -> str:
    """The complaint below the run's report; without where its logs are, because they are gone by then."""
    lines = output.read_text(errors="replace").splitlines()
    said = [
        line.strip() for line in lines if line.strip() and line[0] not in "╭│╰" and "logs are in" not in line
    ]
    return " ".join(said[-TAIL_LINES:]).removeprefix("tenuto: ")
