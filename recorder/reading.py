"""Recordings as arrays: what was written, read back from the file alone.

    ticks, reward = columns("run/recording.rrd", "/env/reward")

and of each environment of a fleet, or of the only one there is:

    for root in env_roots("run/recording.rrd"):
        ticks, reward = columns("run/recording.rrd", f"{root}/env/reward")

Times come as int64: ns on `run_time` (since T0) and `wall` (Unix), counts on `tick`, `episode`, `unit`.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import rerun.chunk as rc
from numpy.typing import NDArray

from recorder.rows import Floats, Ints

TimelineName = Literal["run_time", "wall", "tick", "episode", "unit"]

SCALARS = "Scalars:scalars"
NAMES = "SeriesLines:names"
STATE = "StateChange:state"
TEXT = "TextLog:text"
LEVEL = "TextLog:level"
TRANSLATION = "Transform3D:translation"
QUATERNION = "Transform3D:quaternion"
DOCUMENT = "TextDocument:text"
_DIGITS = "0123456789"
_OF_AN_ENV = re.compile(rf"((?:/[^/]*[{_DIGITS}])?)/(?:env|agent|world)/")  # a root ends with a number


@dataclass(frozen=True, slots=True)
class Span:
    """One state of a state timeline: [start_ns, end_ns) of run time; the last one has no end."""

    state: str
    start_ns: int
    end_ns: int | None


def columns(
    path: str | Path, entity: str, component: str = SCALARS, timeline: TimelineName = "tick"
) -> tuple[Ints, Floats]:
    """One component of one entity, in the order of the timeline (equal times: as written).

    Returns:
        Times int64 [n], and values float64 [n, k]. Rows that are shorter than the longest are filled up
        with NaN at their end. Both are empty (k = 0) where there is nothing.

    Raises:
        RuntimeError: there is no such file, or it is torn (repair it: `python -m recorder.finish`).
    """
    times, rows = _cells(path, entity, component, timeline)
    flat = [np.ravel(np.array(row, np.float64)) for row in rows]
    width = max((len(row) for row in flat), default=0)
    values = np.full((len(flat), width), np.nan)
    for i, row in enumerate(flat):
        values[i, : len(row)] = row
    return times, values


def texts(
    path: str | Path, entity: str, component: str = TEXT, timeline: TimelineName = "run_time"
) -> tuple[Ints, list[str]]:
    """One text component of one entity (log lines, levels, states), in the order of the timeline."""
    times, rows = _cells(path, entity, component, timeline)
    return times, ["".join(row or ()) for row in rows]


def series(path: str | Path, entity: str) -> list[str]:
    """Names of an entity's series, as they were written last: of the columns of its scalars."""
    found: list[str] = []
    for chunk in _chunks(path, content=entity, is_static=True, components=NAMES):
        for row in chunk.to_record_batch().column(NAMES).to_pylist():
            found = list(row or ())
    return found


def spans(path: str | Path, entity: str = "/learner/phase") -> list[Span]:
    """A state timeline as spans of run time; a state that is written again goes on."""
    times, states = texts(path, entity, STATE, "run_time")
    starts = [i for i in range(len(states)) if i == 0 or states[i] != states[i - 1]]
    ends: list[int | None] = [int(times[i]) for i in starts[1:]]
    return [Span(states[i], int(times[i]), end) for i, end in zip(starts, [*ends, None], strict=True)]


def document(path: str | Path, entity: str = "/run_card") -> str:
    """A static text document as it was written last; empty where there is none."""
    found = ""
    for chunk in _chunks(path, content=entity, components=DOCUMENT):
        for row in chunk.to_record_batch().column(DOCUMENT).to_pylist():
            found = "".join(row or ())
    return found


def entities(path: str | Path) -> list[str]:
    """The entities with data, sorted; properties of the recording left out."""
    return sorted({chunk.entity_path for chunk in _chunks(path) if not chunk.entity_path.startswith("/__")})


def env_roots(path: str | Path) -> list[str]:
    """Below which entities those of the environments lie that something was written of: `[""]`, or of a
    fleet `["/env0", "/env1", ...]`, in the order of their numbers. See `recorder.rows.roots`.
    """
    found = {match[1] for entity in entities(path) if (match := _OF_AN_ENV.match(entity))}
    return sorted(found, key=lambda root: int(root[len(root.rstrip(_DIGITS)) :] or 0))


def timelines(path: str | Path, entity: str) -> set[str]:
    """The timelines that every non-static chunk of the entity has."""
    found: set[str] | None = None
    for chunk in _chunks(path, content=entity, is_static=False):
        names = set(chunk.timeline_names)
        found = names if found is None else found & names
    return found or set()


def _cells(path: str | Path, entity: str, component: str, timeline: str) -> tuple[Ints, list[Any]]:
    """Times and cells (lists of instances) in order of time."""
    times: list[NDArray[np.int64]] = []
    cells: list[Any] = []
    for chunk in _chunks(path, content=entity, has_timeline=timeline, components=component):
        batch = chunk.to_record_batch()
        times.append(_integers(batch.column(timeline)))
        cells += batch.column(component).to_pylist()
    flat = np.concatenate(times) if times else np.empty(0, np.int64)
    order = np.argsort(flat, kind="stable")
    present = [i for i in order.tolist() if cells[i] is not None]  # null: a row of another component
    return flat[present], [cells[i] for i in present]


def _chunks(path: str | Path, **wanted: Any) -> list[rc.Chunk]:
    """All chunks that `wanted` describes. A file that is still written to is read as far as it goes."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RRD file has no footer")
        return list(rc.RrdReader(str(path)).stream().filter(**wanted))


def _integers(column: Any) -> NDArray[np.int64]:
    integers: NDArray[np.int64] = column.cast(pa.int64()).to_numpy(zero_copy_only=False)
    return integers
