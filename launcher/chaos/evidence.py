"""What a run left behind, as the judge takes it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from launcher.chaos.faults import Done
from launcher.report import load
from launcher.summary import Summary
from learner import marks
from rtcore import channels
from rtcore.config import ConfigError
from rtcore.run_dir import RunDir

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

REFUSED = re.compile(r"policy (\d+) refused")


@dataclass(frozen=True, slots=True)
class Life:
    """One life of a process: its counters at its end, however that came, and whether it ended in order."""

    counters: Mapping[str, int]
    ended: bool


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What the recording says.

    Attributes:
        ticks: int64 [n], the ticks with a row, in order; one with two rows is there twice.
        pacing_us: float64 [n], how late the env server was for each.
        acted: int64 [m], the policy versions behind the ticks that had one, in order of the ticks.
        published: int64 [k], the versions published, in order of their stamps.
        problem: why it cannot be read; empty: it can.
    """

    ticks: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    pacing_us: Floats = field(default_factory=lambda: np.empty(0, np.float64))
    acted: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    published: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Everything that the judge goes by.

    Attributes:
        done: the faults.
        ended: the run is over; else some of it is still on its way.
        tick_s: the control period.
        num_ticks: deadlines in the run's duration; None: it has none.
        summary: summary.json; None: there is none.
        lives: of each process, oldest first.
        recorded: the recording.
        refused: versions that the agent refused.
        kept: transitions that the learner's replay says were ever added to it; None: nobody can tell.
    """

    done: Sequence[Done]
    ended: bool
    tick_s: float
    num_ticks: int | None
    summary: Summary | None
    lives: Mapping[str, Sequence[Life]]
    recorded: Recorded
    refused: frozenset[int] = frozenset()
    kept: int | None = None

    def total(self, process: str, counter: str) -> int:
        """A counter, over all lives of a process."""
        return sum(life.counters.get(counter, 0) for life in self.lives.get(process, ()))


def gather(run_dir: RunDir, done: Sequence[Done], *, ended: bool) -> Evidence:
    """Read what is there.

    Raises:
        ConfigError: the run's configuration cannot be read.
    """
    config = run_dir.config()
    assert config.env.hz is not None, "a run's configuration is resolved"
    # The recording first: while a run goes on, its counters are then ahead of the rows.
    recorded = read_recording(run_dir.recording_path)
    lives: dict[str, list[Life]] = {}
    for stats in run_dir.read_final_stats():
        lives.setdefault(stats.process, []).append(Life(stats.counters, stats.final))
    summary = None
    with suppress(ConfigError):
        summary = load(run_dir)
    return Evidence(
        done=done,
        ended=ended,
        tick_s=1 / config.env.hz,
        num_ticks=round(config.duration_s * config.env.hz) if config.duration_s else None,
        summary=summary,
        lives=lives,
        recorded=recorded,
        refused=refused(run_dir.log_path(channels.AGENT)),
        kept=_kept(run_dir.learner_dir / "replay" / "marks.bin"),
    )


def read_recording(path: Path) -> Recorded:
    """Read it as far as it goes."""
    from recorder import reading  # loads the recording's library

    try:
        ticks, pacing = reading.columns(path, "/env/pacing_us")
        _, acted = reading.columns(path, "/agent/policy_version")
        _, published = reading.columns(path, "/learner/published_version", timeline="run_time")
    except (RuntimeError, OSError, ValueError) as error:
        return Recorded(problem=" ".join(str(error).split()) or type(error).__name__)
    return Recorded(
        ticks=ticks,
        pacing_us=pacing[:, 0] if pacing.size else np.empty(0, np.float64),
        acted=acted.ravel().astype(np.int64),
        published=published.ravel().astype(np.int64),
    )


def refused(log: Path) -> frozenset[int]:
    """Versions that the agent's log says it refused."""
    found = set()
    with suppress(OSError):
        for line in log.read_text(errors="replace").splitlines():
            with suppress(ValueError, KeyError, TypeError):
                if match := REFUSED.search(json.loads(line)["text"]):
                    found.add(int(match[1]))
    return frozenset(found)


def _kept(path: Path) -> int | None:
    try:
        record = marks.read(path)
    except OSError:
        return None
    return None if record is None else record.added
