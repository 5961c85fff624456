"""Does any process grow? Memory of all four over a long run at a high rate, learning and recording.

    python -m benchmarks.memory --hz 1000 --minutes 15

Sampled every five seconds. What counts is each process's own memory: resident, without what it maps from
files. The replay is such a file, and its pages fill up as the replay does; the kernel takes them back when
it needs them. Both numbers are in the result.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import tyro

from benchmarks.harness import run_system, world, write_result
from benchmarks.outcome import cell
from rtcore import channels
from rtcore.cast import Part
from rtcore.realtime import Rt

PACKAGES = ("eclipse-zenoh", "rerun-sdk", "torch", "numpy", "mujoco")
SAMPLE_S = 5.0
WARM_UP_S = 60.0
SPAN_S = 60.0  # the first and the last minute after the warm-up are compared by their medians
LIMIT = 0.01


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    world: str = "halfcheetah"
    hz: float = 1000.0
    minutes: float = 15.0
    rt: Rt = "auto"
    out: Path = Path("benchmarks/results")


@dataclass(frozen=True)
class Sample:
    """A process's memory at an instant, in bytes."""

    at_s: float
    own: int
    resident: int


@dataclass
class Sampler:
    """Looks now and then at the children of a process.

    Attributes:
        parent: theirs.
        called: the parent's own name; empty: it is not sampled.
        every_s: how often.
        samples: by name of the process.
    """

    parent: psutil.Process = field(default_factory=psutil.Process)
    called: str = ""
    every_s: float = SAMPLE_S
    due_s: float = 0.0
    samples: dict[str, list[Sample]] = field(default_factory=dict)

    def poll(self) -> None:
        """Take samples when it is time."""
        now_s = time.monotonic()
        if now_s < self.due_s:
            return
        self.due_s = now_s + self.every_s
        with suppress(psutil.Error):  # it has ended
            if self.called:
                self._take(self.called, self.parent, now_s)
            for child in self.parent.children():
                with suppress(psutil.Error):
                    self._take(process(child.cmdline()), child, now_s)

    def _take(self, name: str | None, seen: psutil.Process, now_s: float) -> None:
        memory = seen.memory_info()
        if name is not None and memory.rss:  # without any it is about to be gone
            sample = Sample(now_s, memory.rss - memory.shared, memory.rss)
            self.samples.setdefault(name, []).append(sample)


def process(command: Sequence[str]) -> str | None:
    """Which process of a run a command line starts, by name."""
    words = dict(pairwise(command))
    role = words.get("-m")
    if role not in channels.PROCESSES:
        return None
    index = words.get("--index")
    return Part(role, None if index is None else int(index)).name


def growth(samples: list[Sample], warm_up_s: float = WARM_UP_S, span_s: float = SPAN_S) -> dict[str, Any]:
    """The medians of the first and of the last minute after the warm-up, and the ratio, less one.

    Raises:
        ValueError: the samples do not reach beyond the warm-up.
    """
    begin_s, end_s = samples[0].at_s + warm_up_s, samples[-1].at_s
    first = [one for one in samples if begin_s <= one.at_s <= begin_s + span_s]
    last = [one for one in samples if one.at_s >= max(begin_s, end_s - span_s)]
    if not first or not last:
        raise ValueError(
            f"samples over {end_s - samples[0].at_s:.0f} s: must be over more than {warm_up_s:.0f} s"
        )
    found: dict[str, Any] = {}
    for kind in ("own", "resident"):
        before, after = (statistics.median(getattr(one, kind) for one in part) for part in (first, last))
        found[kind] = {"first_mb": before / 1e6, "last_mb": after / 1e6, "growth": after / before - 1}
    return found


def main(arguments: Arguments) -> None:
    """Run, print a table, write the result."""
    base = world(arguments.world, hz=arguments.hz, seconds=60 * arguments.minutes, rt=arguments.rt)
    config = replace(base, recorder=replace(base.recorder, record=True))
    sampler = Sampler()
    outcome = run_system(config, channels.PROCESSES, on_poll=sampler.poll)
    found = {name: growth(samples) for name, samples in sampler.samples.items()}
    print(f"{'MB':16}{'first':>9}{'last':>9}{'growth':>9}   with files: {'first':>9}{'last':>9}")
    for name, row in found.items():
        own, resident = row["own"], row["resident"]
        print(
            f"{name:16}{cell(own['first_mb'], 9, 1)}{cell(own['last_mb'], 9, 1)}{own['growth']:9.2%}"
            f"{'':15}{cell(resident['first_mb'], 9, 1)}{cell(resident['last_mb'], 9, 1)}"
        )
    print(f"rows recorded {outcome.more['recorder']}; ticks {outcome.ticks}, missed {outcome.missed}")
    series = {
        name: [[round(one.at_s - samples[0].at_s, 1), one.own, one.resident] for one in samples]
        for name, samples in sampler.samples.items()
    }
    within = all(row["own"]["growth"] < LIMIT for row in found.values())
    result = {"growth": found, "within_limit": within, "outcome": outcome.as_dict(), "series": series}
    print(f"all below {LIMIT:.0%}: {within}\n{write_result('memory', arguments, PACKAGES, result)}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
