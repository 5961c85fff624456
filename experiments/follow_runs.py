"""Runs of the chain whose world stands still for a while, drifts for as long, and stands still again.

The command line is the product's own, for real processes and for virtual time alike: the preset `chain`
(Algorithm 1; units of 0.2 s and 40 ticks, windows of 20 units), with a drift that is read from a file.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from env_server.worlds.finite import FiniteWorld
from env_server.worlds.registry import make_world
from launcher import regret
from learner import diary
from recorder.reading import columns, texts
from rtcore.run_dir import RunDir

UNIT_S = 0.2
WINDOW = 20  # units
PERIOD = 160  # units, of the sine
PARTS = 3  # still, drifting, still again
GAUGES = ("predicted", "unheld", "trust")

Floats = NDArray[np.float64]
Json = Mapping[str, Any]

ARMS: Mapping[str, Sequence[str]] = {
    "auto": ("auto",),
    "no hold": ("fixed", "--learner.schedule.gamma-f", "1"),
    **{
        f"G = {update}": ("fixed", "--learner.schedule.gamma-f", f"{update / WINDOW:g}")
        for update in (5, 7, 10, 14)
    },
    "live": ("live",),
}


class Course(NamedTuple):
    """How long each of the three parts is, in units."""

    part: int

    @property
    def seconds(self) -> float:
        """Of the whole run."""
        return PARTS * self.part * UNIT_S

    @property
    def windows(self) -> int:
        """Of each part."""
        return self.part // WINDOW

    def drift(self) -> Floats:
        """The value of each unit, [3 part]: a sine in the middle, and before and after it where it begins
        and ends, which is the same, so that nothing jumps.

        sin(phase) = sin(phase + omega part) asks for phase = (pi - omega part) / 2.
        """
        omega = 2.0 * math.pi / PERIOD
        middle = omega * np.arange(self.part) + (math.pi - omega * self.part) / 2
        values = np.full(PARTS * self.part, math.sin(middle[0]))
        values[self.part : 2 * self.part] = np.sin(middle)
        return values

    def write(self, path: Path) -> None:
        """As the file of a recorded drift."""
        rows = (f"{unit},{value!r}\n" for unit, value in enumerate(self.drift().tolist()))
        path.write_text("unit,value\n" + "".join(rows))


@dataclass(frozen=True)
class Chosen:
    """A window as the recording has it.

    Attributes:
        m: its index.
        update: G.
        hold: N.
        predicted: regret that was foreseen with it, summed over its units; NaN where nothing was.
        unheld: the same with N = 0.
        trust: how much of the change that was seen is told from noise; NaN likewise.
        realised: what became of `predicted`, by the tables that came; NaN in the run's last window.
        why: what the log says.
    """

    m: int
    update: int
    hold: int
    predicted: float
    unheld: float
    trust: float
    realised: float
    why: str


class Lived(NamedTuple):
    """What is kept of a run.

    Attributes:
        hold: N of each window; of `live` none, its windows are units.
        regret: of each unit, V*_t - V^pi_t from where the world begins, [3 part].
        learned: the same of the policies without the random actions that are mixed into what acts.
    """

    hold: list[int]
    regret: Floats
    learned: Floats


def command(
    verb: str, arm: str, drift: Path, course: Course, seed: int, run: Path, more: Sequence[str]
) -> list[str]:
    """`tenuto run` or `tenuto sim` for one arm; `more` are settings of the experiment's own."""
    return [
        sys.executable, "-m", "launcher", verb, "chain", "--learner.schedule", *ARMS[arm],
        "--env.drift.kind", "recorded", "--env.drift.path", str(drift), "--seed", str(seed),
        "--duration-s", f"{course.seconds:g}", "--run-dir", str(run), *more,
    ]  # fmt: skip


def carry_out(arguments: Sequence[str]) -> None:
    """Run a command; what it says is shown only if it fails.

    Raises:
        RuntimeError: it did.
    """
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")


def read_summary(run: Path) -> dict[str, Any]:
    """What the run's summary says."""
    found: dict[str, Any] = msgspec.json.decode((run / "summary.json").read_bytes())
    return found


def read_lived(run: Path, course: Course) -> Lived:
    """Windows and regret of a run whose every unit was lived.

    Raises:
        AssertionError: one was not, or the regret is not what the summary says.
    """
    run_dir, summary = RunDir.open(run), read_summary(run)
    config, entries = run_dir.config(), diary.read(run_dir.learner_dir / diary.NAME).entries
    with closing(make_world(config.env, config.seed)) as world:
        assert isinstance(world, FiniteWorld)
        lived = regret.read_lived(entries, world.states, world.actions)
        lost = regret.losses(world, config.learner.gamma, lived.units, lived.policies).start
        learned = {
            version: without(table, config.learner.table.epsilon) for version, table in lived.policies.items()
        }
        less = regret.losses(world, config.learner.gamma, lived.units, learned).start
    assert [one.unit for one in lived.units] == list(range(PARTS * course.part)), "every unit is there"
    assert abs(float(lost.mean()) - summary["regret"]["per_unit"]) < 1e-9, "as in the summary"
    return Lived([one["N"] for one in summary["windows"]], lost, less)


def without(table: Floats, epsilon: float) -> Floats:
    """What was mixed with a share epsilon of uniform actions into `table`, [S, A]; epsilon < 1."""
    found = np.maximum(table - epsilon / table.shape[-1], 0.0)  # rounded to float32 on its way
    shares: Floats = found / found.sum(-1, keepdims=True)
    return shares


def read_chosen(run: Path, course: Course) -> list[Chosen]:
    """Every window from the recording alone: what the timeline and the log say about it.

    Raises:
        AssertionError: the timeline, the log, the summary and the drift's file do not agree.
    """
    recording = run / "recording.rrd"
    assert_drift(recording, course)
    update, hold = (_by_window(recording, name) for name in ("update", "hold"))
    rows = [(one["m"], one["G"], one["N"]) for one in read_summary(run)["windows"]]
    assert rows == [(m, update[m], hold[m]) for m in range(len(rows))], "the summary and the timeline agree"
    assert len(rows) == PARTS * course.windows, "every window is there"
    foreseen = {name: _by_window(recording, name) for name in GAUGES}
    realised = _by_window(recording, "realised")  # told in the window after
    said = explained(recording)
    assert list(said) == list(range(len(rows))), "one line of the log for every window"
    nan = math.nan
    return [
        Chosen(
            m, g, n, realised=realised.get(m + 1, nan), why=said[m],
            **{name: found.get(m, nan) for name, found in foreseen.items()},
        )
        for m, g, n in rows
    ]  # fmt: skip


def explained(recording: Path) -> dict[int, str]:
    """The log's line on each window, in the order in which they were said, without the index.

    Raises:
        AssertionError: there are two on one window.
    """
    found: dict[int, str] = {}
    for line in texts(recording, "/log")[1]:
        head, _, text = line.partition(": ")
        who, _, m = head.rpartition(" ")
        if who == "[learner] window":
            assert int(m) not in found, f"window {m} is explained twice"
            found[int(m)] = text
    return found


def assert_drift(recording: Path, course: Course) -> None:
    """The recording's drift is the file's, unit by unit."""
    units, values = columns(recording, "/env/drift", timeline="unit")
    np.testing.assert_allclose(values[:, 0], course.drift()[units], rtol=0, atol=1e-6)  # float32 on the wire


def _by_window(recording: Path, name: str) -> dict[int, float]:
    """The last value of a gauge in each window, by m; windows without one are left out."""
    times, values = columns(recording, f"/learner/schedule/{name}", timeline="run_time")
    length_ns = round(WINDOW * UNIT_S * 1e9)
    return dict(zip((times // length_ns).tolist(), values[:, 0].tolist(), strict=True)) if len(times) else {}
