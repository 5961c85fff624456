"""A long run of a fleet: does any process grow, and is anything lost or dropped?

    python -m benchmarks.soak --minutes 30 --hz 500 --count 4

This is `tenuto run` as anybody starts it, with the cheap world, a learner that is given little to do, and a
recording. Memory is looked at every two seconds. What counts is each process's own: resident, without what
it maps from files (RssAnon, not RssFile nor RssShmem; statm has both as `shared`). The replay is such a file.
It is made small enough here that its ring is full after some tens of seconds; what the recording takes on
disk is not memory.

"Flat" is a statement about the second half. It is cut into ten blocks with a median each. The slope is the
median of the nine steps from one block to the next: a leak is in most of them, an allocator that once takes
a megabyte is in one. Its interval is that of the sign test, from the second lowest of nine to the second
highest: 1 - 2 * 10 / 512 = 96 %. Memory grows if the slope is above `LIMIT_MB_H` with all of its interval,
or if the last block has `LIMIT_SHARE` more than the first one. It is flat if neither that nor the slope
itself is above. Else the run was too short to tell, and so is one whose second half begins in the warm-up,
where caches fill.

The exit code is 1 if a process grows, if anything was lost, dropped, rejected, not on disk or restarted, or
if a count does not reconcile. Missed and skipped deadlines are told; they are the machine's.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import psutil
import tyro
from numpy.typing import NDArray

from benchmarks.harness import ROOT, BenchmarkError, world, write_result
from benchmarks.memory import Sample, Sampler
from env_server.worlds.period import num_ticks
from launcher.child_run import started
from launcher.stealing import StealMeter
from launcher.summary import Summary, discrepancies
from rtcore import cast, epoch
from rtcore.config import RunConfig
from rtcore.config_check import check
from rtcore.realtime import Rt
from rtcore.run_dir import RunDir

PACKAGES = ("eclipse-zenoh", "rerun-sdk", "torch", "numpy")
POLL_S, SAMPLE_S, LEAST_SAMPLES = 0.2, 2.0, 60
# The logs' caches keep 100 s, and the pools of Zenoh and of the allocators settle with them; those of the
# recorder took a last step of some MB in minute 3, 7 or 13, in three long runs.
WARM_UP_S = 840.0
BLOCKS = 10
LIMIT_MB_H = 4.0  # 100 MB in a day
LIMIT_SHARE = 0.03  # in a half of 15 minutes 1 MB of an env server's 32, 5 MB of a learner's 170
EPISODE_STEPS = 1000  # 2 s at 500 Hz: the launcher keeps every return of the run, 16 bytes each
END_LIMIT_S = 120.0  # beyond the duration: 15 s for the start, 20 s for the end, and a busy machine
Floats = NDArray[np.float64]
Verdict = Literal["flat", "grows", "too short"]


@dataclass(frozen=True)
class Arguments:
    """What to run."""

    minutes: float = 30.0
    hz: float = 500.0
    count: int = 4  # environments
    utd: float = 0.01  # gradient steps per transition
    detail: Literal["full", "light"] = "light"  # of the recording
    rt: Rt = "auto"
    run_dir: Path | None = None  # of the run, which is kept then
    out: Path = Path("benchmarks/results")


@dataclass(frozen=True)
class Trend:
    """How a process's own memory went.

    Attributes:
        early_mb: at a tenth of the run, the median of a twentieth of it.
        last_mb: at the end, likewise.
        mapped_mb: of files, at the end.
        slope_mb_h: in the second half, in MB/h, and the ends of its 96 % interval.
        grown: from the first to the last tenth of the second half, as a share.
    """

    early_mb: float
    last_mb: float
    mapped_mb: float
    slope_mb_h: float
    low_mb_h: float
    high_mb_h: float
    grown: float


def configure(arguments: Arguments) -> RunConfig:
    """The run: the ring holds 50 s of four environments at 500 Hz."""
    base = world("pointmass", hz=arguments.hz, seconds=60 * arguments.minutes, rt=arguments.rt)
    learner = replace(
        base.learner, utd=arguments.utd, hidden=(32, 32), batch=64, replay_capacity=100_000,
        learning_starts=1000,
    )  # fmt: skip
    config = replace(
        base,
        env=replace(base.env, count=arguments.count, episode_steps=EPISODE_STEPS),
        learner=learner,
        recorder=replace(base.recorder, record=True, detail=arguments.detail),
    )
    check(config)
    return config


def trend(samples: Sequence[Sample], begin_s: float, end_s: float) -> Trend:
    """The trend of the samples in [begin_s, end_s].

    Raises:
        ValueError: a block of the second half has no sample.
    """
    within = [one for one in samples if begin_s <= one.at_s <= end_s]
    at_s = np.array([one.at_s for one in within])
    own_mb = np.array([one.own for one in within]) / 1e6
    mapped_mb = np.array([one.resident - one.own for one in within]) / 1e6
    run_s = end_s - begin_s
    early = np.abs(at_s - begin_s - run_s / 10) <= run_s / 40
    last = at_s >= end_s - run_s / 20
    blocks_mb = _blocks(at_s, own_mb, begin_s + run_s / 2, end_s)
    steps_mb_h = np.sort(np.diff(blocks_mb)) / (run_s / 2 / BLOCKS / 3600)
    if not early.any() or not last.any():
        raise ValueError("no sample at a tenth of the run, or at its end")
    return Trend(
        early_mb=float(np.median(own_mb[early])),
        last_mb=float(np.median(own_mb[last])),
        mapped_mb=float(np.median(mapped_mb[last])),
        slope_mb_h=float(np.median(steps_mb_h)),
        low_mb_h=float(steps_mb_h[1]),
        high_mb_h=float(steps_mb_h[-2]),
        grown=float(blocks_mb[-1] / blocks_mb[0] - 1),
    )


def _blocks(at_s: Floats, own_mb: Floats, begin_s: float, end_s: float) -> Floats:
    """The median of each block."""
    number = np.floor((at_s - begin_s) / (end_s - begin_s) * BLOCKS)
    blocks = [own_mb[number == n] for n in range(BLOCKS)]
    if not all(block.size for block in blocks):
        raise ValueError(f"{len(at_s)} samples: not one in each block of the second half")
    return np.array([np.median(block) for block in blocks])


def verdict(found: Trend, run_s: float) -> Verdict:
    """Whether it grows."""
    if run_s / 2 < WARM_UP_S:
        return "too short"
    if found.low_mb_h > LIMIT_MB_H or found.grown > LIMIT_SHARE:
        return "grows"
    return "flat" if found.slope_mb_h <= LIMIT_MB_H else "too short"


def accounts(summary: Summary) -> dict[str, dict[str, Any]]:
    """What became of each environment's deadlines and transitions."""
    names = ("ticks", "resets", "missed", "overruns", "skipped", "down", "produced", "learned", "lost")
    rows = summary.get("envs")
    if rows is None:
        rows = {"env": summary | summary["deadlines"] | summary["transitions"]}
    return {env: {name: row[name] for name in (*names, "duplicate")} for env, row in rows.items()}


def problems(summary: Summary, num_ticks: int) -> list[str]:
    """What was lost, dropped, rejected or started again, and what does not reconcile."""
    found = discrepancies(summary)
    found += [f"ended: {summary['ended']}"] if summary["ended"] != "duration" else []
    for env, row in accounts(summary).items():
        found += [f"{env}: {name} {row[name]}" for name in ("lost", "down") if row[name]]
        if (passed := row["ticks"] + row["skipped"] + row["down"]) != num_ticks:
            found.append(f"{env}: {passed} of {num_ticks} deadlines")
    counted = {"recorder dropped": summary["recorder"]["dropped"]}
    counted |= {f"not on disk, {name}": count for name, count in summary["disk"].items()}
    counted |= {f"messages {name}": summary["messages"][name] for name in ("rejected", "denied")}
    counted |= {f"restarts of {process}": count for process, count in summary["restarts"].items()}
    counted |= {"killed at the end": len(summary["forced"])}
    return found + [f"{name}: {count}" for name, count in counted.items() if count]


def soak(config: RunConfig, path: Path) -> dict[str, Any]:
    """Run it to its end; everything that is to be told of it.

    Raises:
        BenchmarkError: there is no summary.
    """
    steal, limit_s = StealMeter(), time.monotonic() + config.duration_s + END_LIMIT_S
    said = path.with_suffix(".out")
    with said.open("wb") as output, started(config, path, output=output, cwd=ROOT) as child:
        every_s = min(SAMPLE_S, config.duration_s / LEAST_SAMPLES)
        sampler = Sampler(psutil.Process(child.pid), "launcher", every_s)
        while child.poll() is None and time.monotonic() < limit_s:
            sampler.poll()
            time.sleep(POLL_S)
    run_dir = RunDir(path)
    beginning = epoch.read(run_dir.epoch_path) if run_dir.path.exists() else None
    if beginning is None or not run_dir.summary_path.exists():
        raise BenchmarkError(
            f"tenuto run ended with code {child.returncode}: {said.read_text(errors='replace')[-3000:]}"
        )
    summary = json.loads(run_dir.summary_path.read_text())
    recording = run_dir.recording_path
    return {
        "code": child.returncode,
        "stolen_s": steal.elapsed_s(),
        "summary": {name: value for name, value in summary.items() if name not in ("returns", "windows")},
        "samples": sampler.samples,
        "t0_s": beginning.t0_ns / 1e9,
        "recording_mb": recording.stat().st_size / 1e6 if recording.exists() else 0.0,
    }


def judged(config: RunConfig, found: dict[str, Any]) -> dict[str, Any]:
    """The result: memory by process, accounts by environment, and what is wrong."""
    summary, samples, t0_s = found["summary"], found.pop("samples"), found.pop("t0_s")
    wrong = problems(summary, num_ticks(config.env, config.duration_s))
    wrong += [f"tenuto run ended with code {found['code']}"] if found["code"] else []
    memory = {}
    for name in ("launcher", *cast.names(config)):
        try:
            one = trend(samples.get(name, ()), t0_s, t0_s + config.duration_s)
        except ValueError as error:
            wrong.append(f"{name}: {error}")
            continue
        told = verdict(one, config.duration_s)
        memory[name] = {"verdict": told} | asdict(one)
        if told == "grows":
            wrong.append(f"{name} grows by {one.slope_mb_h:.1f} MB/h, {one.grown:.1%} in the second half")
    series = {
        name: [[round(one.at_s - t0_s, 1), one.own, one.resident] for one in taken]
        for name, taken in samples.items()
    }
    return {
        "wrong": wrong, "memory": memory, "accounts": accounts(summary), "limit_mb_h": LIMIT_MB_H, **found,
        "series": series,
    }  # fmt: skip


def table(result: dict[str, Any]) -> str:
    """What to print."""
    lines = [f"{'own MB':18}{'at 10 %':>9}{'end':>9}{'mapped':>9}{'MB/h':>9}{'96 % interval':>18}"]
    for name, row in result["memory"].items():
        interval = f"{row['low_mb_h']:.1f} .. {row['high_mb_h']:.1f}"
        lines.append(
            f"{name:18}{row['early_mb']:9.1f}{row['last_mb']:9.1f}{row['mapped_mb']:9.1f}"
            f"{row['slope_mb_h']:9.2f}{interval:>18}{row['grown']:8.1%}  {row['verdict']}"
        )
    rows = result["accounts"]
    names = list(next(iter(rows.values())))
    lines.append(f"\n{'':10}" + "".join(f"{name:>10}" for name in names))
    lines += [f"{env:10}" + "".join(f"{row[name]:>10}" for name in names) for env, row in rows.items()]
    summary = result["summary"]
    lines.append(
        f"\n{summary['learner']['gradient_steps']} gradient steps; recorder {summary['recorder']}, "
        f"{result['recording_mb']:.0f} MB on disk; rejected {summary['messages']['rejected']}; "
        f"restarts {sum(summary['restarts'].values())}; "
        f"silences for want of a core {sum(one['what'] == 'starved' for one in summary['supervision'])}"
    )
    flat = all(row["verdict"] == "flat" for row in result["memory"].values())
    memory = "memory flat" if flat else "too short to tell whether memory is flat"
    return "\n".join([*lines, *(result["wrong"] or [f"nothing lost, nothing dropped, {memory}"])])


def main(arguments: Arguments) -> int:
    """Run, judge, print, write the result."""
    config = configure(arguments)
    with tempfile.TemporaryDirectory(prefix="tenuto-") as directory:
        path = (arguments.run_dir or Path(directory) / "run").absolute()
        path.parent.mkdir(parents=True, exist_ok=True)
        result = judged(config, soak(config, path))
    print(table(result))
    print(write_result("soak", replace(arguments, run_dir=None), PACKAGES, result))
    return 1 if result["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
