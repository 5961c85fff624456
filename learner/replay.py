"""What the learner remembers: the newest transitions, in a ring of preallocated arrays.

One thread owns a `Replay`. Actions are in [-1, 1], whoever adds a transition has scaled them; those of a
finite world are their numbers.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learner.recency import RecentUnits

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]

_SCHEMA = 2  # 1: without the number of transitions ever added
_CURSOR = "cursor.json"


class ReplayError(ValueError):
    """A stored replay does not fit: says every difference on one line."""


@dataclass(frozen=True, slots=True)
class Batch:
    """B transitions, in arrays that `Replay.sample` fills anew each time."""

    observation: Floats  # [B, observation_dim]
    action: Floats  # [B, action_dim], in [-1, 1]
    reward: Floats  # [B], per tick
    next_observation: Floats  # [B, observation_dim]
    terminated: Bools  # [B]: bootstrap with 0; a truncated transition is not terminated


@dataclass(frozen=True, slots=True)
class Columns:
    """The ring's storage, one row per transition."""

    observation: Floats
    action: Floats
    reward: Floats
    next_observation: Floats
    terminated: Bools
    unit: NDArray[np.int32]  # t, rises with insertion


def make_batch(size: int, observation_dim: int, action_dim: int) -> Batch:
    """Zeroed arrays for `size` transitions."""
    return Batch(
        observation=np.zeros((size, observation_dim), np.float32),
        action=np.zeros((size, action_dim), np.float32),
        reward=np.zeros(size, np.float32),
        next_observation=np.zeros((size, observation_dim), np.float32),
        terminated=np.zeros(size, np.bool_),
    )


class Replay:
    """A ring of `capacity` transitions; the newest overwrites the oldest once it is full.

    In memory it takes the pages of its arrays only as transitions come in. For one in files, and one
    that was there before, see `open_replay`. Its length is the number of transitions held.

    Attributes:
        added: transitions ever added; they are numbered from 0, so the newest is `added` - 1.
        raised_units: transitions that came with an older unit than their predecessor's and were
            filed under the newest one, so that units rise with insertion.
    """

    def __init__(self, capacity: int, observation_dim: int, action_dim: int) -> None:
        self.capacity, self.observation_dim, self.action_dim = capacity, observation_dim, action_dim
        layout = _layout(capacity, observation_dim, action_dim)
        self._columns = Columns(**{name: np.empty(shape, dtype) for name, (shape, dtype) in layout.items()})
        self._head = 0  # where the next transition goes
        self._size = 0
        self._directory: Path | None = None
        self.added = 0
        self.raised_units = 0

    def __len__(self) -> int:
        return self._size

    @classmethod
    def over(cls, columns: Columns, head: int, size: int, added: int, directory: Path) -> Replay:
        """A replay over arrays that are mapped from files in `directory`."""
        replay = cls(len(columns.reward), columns.observation.shape[1], columns.action.shape[1])
        replay._columns, replay._head, replay._size = columns, head, size
        replay._directory, replay.added = directory, added
        return replay

    @property
    def newest_unit(self) -> int:
        """Unit of the newest transition; -1 when there is none."""
        return int(self._columns.unit[self._head - 1]) if self._size else -1

    def add(
        self,
        observation: Floats,
        action: Floats,
        reward: float,
        next_observation: Floats,
        terminated: bool,
        unit: int,
    ) -> None:
        """Remember one transition. `action` is in [-1, 1]; `unit` is the unit t of its tick."""
        if unit < self.newest_unit:
            self.raised_units += 1
            unit = self.newest_unit
        row, columns = self._head, self._columns
        columns.observation[row] = observation
        columns.action[row] = action
        columns.reward[row] = reward
        columns.next_observation[row] = next_observation
        columns.terminated[row] = terminated
        columns.unit[row] = unit
        self._head = (row + 1) % self.capacity
        self._size = min(self._size + 1, self.capacity)
        self.added += 1

    def read(self, start: int, limit: int) -> Columns:
        """Copies of the transitions numbered `start` and on, oldest first, at most `limit` of them.

        Those that were overwritten meanwhile are missing: it begins with `start` or with the oldest held,
        number `added` - len(self), whichever is newer.
        """
        first = max(start, self.added - self._size)
        rows = np.arange(first, min(first + limit, self.added)) + (self._head - self.added)
        taken = {
            column.name: np.take(getattr(self._columns, column.name), rows, axis=0, mode="wrap")
            for column in fields(self._columns)
        }
        return Columns(**taken)

    def count_since(self, unit: int) -> int:
        """How many of the newest transitions belong to `unit` or later."""
        units = self._columns.unit
        newer = units[: self._head]  # written since the ring last wrapped, in order
        sought = np.int32(unit)  # of the column's type: for any other, the whole column would be converted
        count = self._head - int(np.searchsorted(newer, sought))
        if count == self._head and self._size == self.capacity:
            older = units[self._head :]
            count += len(older) - int(np.searchsorted(older, sought))
        return count

    def sample(
        self,
        rng: np.random.Generator,
        batch: Batch,
        since_unit: int | None = None,
        recency: float | None = None,
    ) -> None:
        """Fill `batch` with transitions drawn with replacement: uniformly, or the newer the likelier.

        Args:
            rng: where the draw comes from.
            batch: filled in place.
            since_unit: draw only from this unit and later ones; None: from all.
            recency: draw a unit by its age first, exponential with this mean in units, then uniformly
                within the unit (`learner.recency`); None: uniformly.

        Raises:
            ValueError: there is no transition to draw from.
        """
        count = self._count_from(since_unit)
        if recency is None:
            rows = rng.integers(0, count, len(batch.reward))
        else:
            rows = self._by_age(count).rows(rng.random((2, len(batch.reward))), recency)
        rows += self._head - count  # from -capacity on: a negative row counts from the ring's end
        for column in fields(batch):
            # mode="wrap" resolves the negative rows, and unlike "raise" writes to `out` unbuffered
            stored, drawn = getattr(self._columns, column.name), getattr(batch, column.name)
            np.take(stored, rows, axis=0, out=drawn, mode="wrap")

    def mean_unit(self, since_unit: int | None = None, recency: float | None = None) -> float:
        """The mean unit of what `sample` draws, asked the same way.

        Raises:
            ValueError: there is no transition to draw from.
        """
        count = self._count_from(since_unit)
        if recency is not None:
            return self._by_age(count).mean_unit(recency)
        rows = np.arange(self._head - count, self._head)
        return float(np.take(self._columns.unit, rows, mode="wrap").mean())

    def _count_from(self, since_unit: int | None) -> int:
        count = self._size if since_unit is None else self.count_since(since_unit)
        if count == 0:
            raise ValueError(f"since_unit = {since_unit}: no transition to draw from, {self._size} held")
        return count

    def _by_age(self, count: int) -> RecentUnits:
        units, end = self._columns.unit, self._head or self._size
        return RecentUnits(units[end : self._size], units[:end], count)

    def content_hash(self) -> str:
        """SHA-256 over the transitions held, oldest first."""
        digest = hashlib.sha256()
        rows = np.arange(self._head - self._size, self._head)
        for column in fields(self._columns):
            digest.update(np.take(getattr(self._columns, column.name), rows, axis=0, mode="wrap").tobytes())
        return digest.hexdigest()

    def flush(self) -> None:
        """Write a file-backed replay to its directory; in memory, do nothing."""
        if self._directory is None:
            return
        for column in fields(self._columns):
            stored = getattr(self._columns, column.name)
            if isinstance(stored.base, np.memmap):
                stored.base.flush()
        cursor = {
            **_shape(self.capacity, self.observation_dim, self.action_dim),
            "head": self._head,
            "size": self._size,
            "added": self.added,
        }
        temporary = self._directory / f"{_CURSOR}.new"
        temporary.write_text(json.dumps(cursor))
        temporary.replace(self._directory / _CURSOR)


def open_replay(directory: Path, capacity: int, observation_dim: int, action_dim: int) -> Replay:
    """The replay in `directory`, as of its last `flush`; an empty one if there is none.

    Raises:
        ReplayError: the one there has another capacity or other dimensions, or cannot be read.
    """
    directory.mkdir(parents=True, exist_ok=True)
    wanted = _shape(capacity, observation_dim, action_dim)
    head, size, added = _read_cursor(directory, wanted)
    columns = {}
    for name, (shape, dtype) in _layout(capacity, observation_dim, action_dim).items():
        path = directory / f"{name}.bin"
        if size and not path.is_file():
            raise ReplayError(f"{path}: missing")
        mapped = np.memmap(path, dtype, "r+" if size else "w+", shape=shape)
        columns[name] = np.asarray(mapped)  # a plain view: indexing a memmap object is slower
    return Replay.over(Columns(**columns), head, size, added, directory)


def _read_cursor(directory: Path, wanted: dict[str, int]) -> tuple[int, int, int]:
    try:
        found = json.loads((directory / _CURSOR).read_text())
        head, size, added = int(found["head"]), int(found["size"]), int(found.get("added", 0))
    except FileNotFoundError:
        return 0, 0, 0
    except (ValueError, KeyError, TypeError) as error:
        raise ReplayError(f"{directory / _CURSOR}: not readable ({error})") from None
    differences = [
        f"{key} {found.get(key)} (wanted {value})" for key, value in wanted.items() if found.get(key) != value
    ]
    if differences:
        raise ReplayError(f"{directory}: {', '.join(differences)}")
    if not (0 <= size <= wanted["capacity"] and 0 <= head < wanted["capacity"] and size <= added):
        raise ReplayError(f"{directory / _CURSOR}: head {head}, size {size}, added {added}: outside the ring")
    return head, size, added


def _shape(capacity: int, observation_dim: int, action_dim: int) -> dict[str, int]:
    return {
        "schema": _SCHEMA,
        "capacity": capacity,
        "observation_dim": observation_dim,
        "action_dim": action_dim,
    }


def _layout(
    capacity: int, observation_dim: int, action_dim: int
) -> dict[str, tuple[tuple[int, ...], type[np.generic]]]:
    return {
        "observation": ((capacity, observation_dim), np.float32),
        "action": ((capacity, action_dim), np.float32),
        "reward": ((capacity,), np.float32),
        "next_observation": ((capacity, observation_dim), np.float32),
        "terminated": ((capacity,), np.bool_),
        "unit": ((capacity,), np.int32),
    }
