"""The files of a replay that outlives its process: columns, marks, and what the disk has for certain.

The ring is `MARGIN` rows longer than what it holds, so that rows not committed yet never lie over rows that
count. A kill -9 leaves the newest mark, and exactly its rows. When the host itself ends, pages that were not
on the disk are lost in any order: then `synced.bin` counts, which was written after its rows were on the
disk, and which reserves the rows that were written since.
"""

from __future__ import annotations

import sys
import threading
from dataclasses import replace
from pathlib import Path

from learner.columns import Columns, MappedColumns
from learner.marks import Marks, MarksError, Record, pack, unpack
from rtcore.files import write_atomic

MARGIN = 1024  # rows between two commits, at most
SCHEMA = 4  # 3: of one environment, which had no name; 2: the cursor was written at the end alone
_NOTE_BYTES = 4096  # of each environment, beside an observation
_MOST_RESERVED = 1 << 16  # rows; the oldest so many are given up when the host ends
MARKS, _SYNCED, _OLD_CURSOR = "marks.bin", "synced.bin", "cursor.json"


class Store:
    """One ring's files. One thread adds and commits; any may sync.

    Attributes:
        columns: the arrays, `capacity` + `MARGIN` rows.
        newest: the record that counts.
    """

    def __init__(
        self,
        directory: Path,
        capacity: int,
        mapped: MappedColumns,
        marks: Marks,
        synced: Record | None,
        boot: str,
    ) -> None:
        """Use `open`."""
        self.columns: Columns = mapped.columns
        self._mapped, self._marks, self._boot = mapped, marks, boot
        self._path = directory / _SYNCED
        self._rows = capacity + MARGIN
        self._reserve = max(MARGIN, min(capacity // 16, _MOST_RESERVED))
        self._syncing = threading.Lock()
        self._synced = synced
        # before the first there is nothing to protect
        self._reserved = sys.maxsize if synced is None else synced.until
        self._backed = 0  # number of the first row that the disk may have no place for

    @property
    def newest(self) -> Record:
        """The record that counts."""
        return self._marks.newest

    @classmethod
    def open(
        cls,
        directory: Path,
        capacity: int,
        observation_dim: int,
        action_dim: int,
        boot: str,
        envs: int = 1,
    ) -> Store:
        """The files in `directory`, which are made if there are none. The note that goes with a commit has
        room for the places in the logs of `envs` environments.

        Raises:
            ValueError: they are of another shape, damaged, or of an older version.
            OSError: they cannot be read or made.
        """
        directory.mkdir(parents=True, exist_ok=True)
        if (directory / _OLD_CURSOR).exists():
            raise MarksError(f"{directory}: schema 2 or older (wanted {SCHEMA})")
        path, rows = directory / MARKS, capacity + MARGIN
        if not path.exists() and any(directory.glob("*.bin")):
            raise MarksError(f"{path}: missing")
        shape = {
            "schema": SCHEMA,
            "capacity": capacity,
            "observation_dim": observation_dim,
            "action_dim": action_dim,
        } | ({"envs": envs} if envs > 1 else {})
        marks = Marks.open(path, shape, envs * (_NOTE_BYTES + 4 * observation_dim))
        mapped = MappedColumns.open(directory, rows, observation_dim, action_dim, new=marks.newest.added == 0)
        synced = _read(directory / _SYNCED)
        if marks.newest.boot != boot:
            marks.write(_after_a_crash(synced, capacity, boot))
        return cls(directory, capacity, mapped, marks, synced, boot)

    def room(self, added: int) -> int:
        """The number of the first row that may not be added yet, greater than `added`.

        Raises:
            OSError: the disk has no place.
            RuntimeError: `MARGIN` rows were added and not committed.
        """
        committed = self.newest
        if added >= committed.added + MARGIN:
            raise RuntimeError(f"{added - committed.added} transitions added and not committed")
        if added >= self._backed:
            row = added % self._rows
            self._backed = added + self._mapped.back(row) - row
        if added >= self._reserved:
            self.sync(committed)
        return min(committed.added + MARGIN, self._backed, self._reserved)

    def commit(self, added: int, oldest: int, note: bytes) -> None:
        """Let the rows from `oldest` to `added` - 1 count, and the note with them.

        Raises:
            ValueError: the note is too long; nothing has changed then.
        """
        self._marks.write(Record(added, oldest, note, self._boot))

    def sync(self, record: Record, *, last: bool = False) -> None:
        """Have the disk keep what was committed as `record`. For any thread.

        Args:
            record: the newest, now or a while ago.
            last: nothing will be added.

        Raises:
            OSError: it does not.
        """
        with self._syncing:
            if self._synced is not None and record.added < self._synced.added:
                return
            if self._reserved == sys.maxsize:  # bounds what is written meanwhile
                self._reserved = self._marks.newest.added + self._reserve
            until = record.added if last else max(record.added + self._reserve, self._reserved)
            self._mapped.sync()
            synced = replace(record, until=until)
            write_atomic(self._path, pack(synced, 0))
            self._synced, self._reserved = synced, until


def _read(path: Path) -> Record | None:
    """What the disk has for certain; None if nothing."""
    try:
        found = unpack(path.read_bytes())
    except FileNotFoundError:
        return None
    return None if found is None else found.record


def _after_a_crash(synced: Record | None, capacity: int, boot: str) -> Record:
    """What counts when pages may be missing: what was synced, less what was written over since."""
    if synced is None:
        return Record(boot=boot)
    written_over = synced.until - (capacity + MARGIN)
    oldest = max(0, synced.oldest, written_over, synced.added - capacity)
    return replace(synced, oldest=min(oldest, synced.added), boot=boot, until=0)
