"""What the learner remembers: the newest transitions, in a ring of preallocated arrays.

One thread owns a `Replay`. Actions are in [-1, 1], whoever adds a transition has scaled them; those of a
finite world are their numbers.
"""

from __future__ import annotations

import hashlib
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np

from learner.columns import Batch, Columns, Floats, in_memory, make_batch
from learner.marks import Record
from learner.recency import RecentUnits, Units
from learner.store import Store
from rtcore.epoch import this_boot

__all__ = ["Batch", "Columns", "Floats", "Replay", "ReplayError", "make_batch", "open_replay"]


class ReplayError(ValueError):
    """A stored replay does not fit: says every difference on one line."""


class Replay:
    """A ring of `capacity` transitions; the newest overwrites the oldest once it is full.

    In memory it takes the pages of its arrays only as transitions come in. For one in files, see
    `open_replay`: of that, what was committed survives the process. Its length is the number of transitions
    held.

    Attributes:
        added: transitions ever added; they are numbered from 0, so the newest is `added` - 1.
        raised_units: transitions that came with an older unit than their predecessor's and were
            filed under the newest one, so that units rise with insertion.
        fault: why the disk failed a replay in files, which has been in memory since; None: it has not.
    """

    def __init__(self, capacity: int, observation_dim: int, action_dim: int) -> None:
        self.capacity, self.observation_dim, self.action_dim = capacity, observation_dim, action_dim
        self._columns = in_memory(capacity, observation_dim, action_dim)
        self._rows = capacity  # of the ring; in files some more than it holds
        self._head = 0  # where the next transition goes
        self._size = 0
        self._store: Store | None = None
        self._until = sys.maxsize  # number of the first transition that there is no room for yet
        self._committed = 0  # transitions in files when the disk failed
        self.added = 0
        self.raised_units = 0
        self.fault: OSError | None = None

    def __len__(self) -> int:
        return self._size

    @classmethod
    def over(cls, store: Store, capacity: int, observation_dim: int, action_dim: int) -> Replay:
        """A replay over files, with what counts in them."""
        replay, found = cls(capacity, observation_dim, action_dim), store.newest
        replay._columns, replay._store = store.columns, store
        replay._rows = len(store.columns.reward)
        replay._head, replay._size = found.added % replay._rows, found.added - found.oldest
        replay.added = replay._until = found.added
        return replay

    @property
    def unbacked(self) -> int:
        """Transitions that are in memory alone, because the disk failed."""
        return 0 if self.fault is None else self.added - self._committed

    @property
    def committed(self) -> Record | None:
        """What survives the process; None of a replay in memory. For any thread."""
        store = self._store  # read once: the owner may give it up meanwhile
        return None if store is None else store.newest

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
        if self.added == self._until:
            self._make_room()
        row, columns = self._head, self._columns
        columns.observation[row] = observation
        columns.action[row] = action
        columns.reward[row] = reward
        columns.next_observation[row] = next_observation
        columns.terminated[row] = terminated
        columns.unit[row] = unit
        self._head = (row + 1) % self._rows
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
        older, newer = self._units()
        sought = np.int32(unit)  # of the column's type: for any other, the whole column would be converted
        count = len(newer) - int(np.searchsorted(newer, sought))
        if count == len(newer):
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
        return RecentUnits(*self._units(), count)

    def _units(self) -> tuple[Units, Units]:
        """Those held, rising: the older ones in the ring's end, if it has wrapped, and those after."""
        units, end = self._columns.unit, self._head or self._rows
        first = end - self._size
        if first < 0:
            return units[first:], units[:end]
        return units[:0], units[first:end]

    def content_hash(self) -> str:
        """SHA-256 over the transitions held, oldest first."""
        digest = hashlib.sha256()
        rows = np.arange(self._head - self._size, self._head)
        for column in fields(self._columns):
            digest.update(np.take(getattr(self._columns, column.name), rows, axis=0, mode="wrap").tobytes())
        return digest.hexdigest()

    # -- durability

    def commit(self, note: bytes) -> None:
        """Let everything added so far survive the process, and `note` with it, or, if the process ends within
        this call, nothing since the last commit. A replay in memory forgets it.

        Raises:
            ValueError: the note is too long; nothing has changed then.
        """
        if self._store is not None:
            self._store.commit(self.added, self.added - self._size, note)
            self._until = self.added  # to be asked for anew

    def sync(self, record: Record, *, last: bool = False) -> None:
        """Let what was `committed` survive the host as well. For any thread; see `Store.sync`.

        Raises:
            OSError: the disk failed, now or before.
        """
        store = self._store  # read once: the owner may give it up meanwhile
        if store is not None:
            store.sync(record, last=last)
        elif self.fault is not None:
            raise self.fault

    def _make_room(self) -> None:
        """Have the files take further rows; without a place on the disk, go on in memory."""
        assert self._store is not None
        try:
            self._until = self._store.room(self.added)
        except OSError as error:
            self.fault, self._until = error, sys.maxsize
            self._committed, self._store = self._store.newest.added, None
            self._columns = self._copied()

    def _copied(self) -> Columns:
        """The columns in memory, with what is held."""
        copy = in_memory(self._rows, self.observation_dim, self.action_dim)
        first = self._head - self._size
        for part in (
            slice(max(0, first), self._head),
            slice(first % self._rows if first < 0 else self._rows, None),
        ):
            for column in fields(copy):
                getattr(copy, column.name)[part] = getattr(self._columns, column.name)[part]
        return copy


def open_replay(
    directory: Path,
    capacity: int,
    observation_dim: int,
    action_dim: int,
    *,
    envs: int = 1,
    boot: str | None = None,
) -> Replay:
    """The replay in `directory` with all that was committed to it; an empty one if there is none.

    Where the disk has no place for it, it is in memory and says why in `fault`.

    Args:
        directory: made if need be.
        capacity: transitions held.
        observation_dim: of the world.
        action_dim: of the world.
        envs: environments whose place in the log is committed with the rows.
        boot: of the host; None: this one. After another one only what was synced counts.

    Raises:
        ReplayError: the one there has another capacity or other dimensions, is damaged, or older.
    """
    try:
        boot = this_boot() if boot is None else boot
        store = Store.open(directory, capacity, observation_dim, action_dim, boot, envs)
    except OSError as error:
        replay = Replay(capacity, observation_dim, action_dim)
        replay.fault = error
        return replay
    except ValueError as error:
        raise ReplayError(str(error)) from error
    return Replay.over(store, capacity, observation_dim, action_dim)
