"""The arrays behind a replay, in memory or mapped from files whose place on the disk is taken ahead.

And those that a draw from it fills.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]

CHUNK_BYTES = 16 << 20  # of the disk taken at a time: 5 ms on a disk in memory, every 8 minutes at 200 Hz


@dataclass(frozen=True, slots=True)
class Columns:
    """The ring's storage, one row per transition."""

    observation: Floats
    action: Floats
    reward: Floats
    next_observation: Floats
    terminated: Bools
    unit: NDArray[np.int32]  # t, rises with insertion


@dataclass(frozen=True, slots=True)
class Batch:
    """B transitions, in arrays that `Replay.sample` fills anew each time."""

    observation: Floats  # [B, observation_dim]
    action: Floats  # [B, action_dim], in [-1, 1]
    reward: Floats  # [B], per tick
    next_observation: Floats  # [B, observation_dim]
    terminated: Bools  # [B]: bootstrap with 0; a truncated transition is not terminated


def make_batch(size: int, observation_dim: int, action_dim: int) -> Batch:
    """Zeroed arrays for `size` transitions."""
    return Batch(
        observation=np.zeros((size, observation_dim), np.float32),
        action=np.zeros((size, action_dim), np.float32),
        reward=np.zeros(size, np.float32),
        next_observation=np.zeros((size, observation_dim), np.float32),
        terminated=np.zeros(size, np.bool_),
    )


def in_memory(rows: int, observation_dim: int, action_dim: int) -> Columns:
    """Arrays that take pages only as they are written to."""
    layout = _layout(rows, observation_dim, action_dim)
    return Columns(**{name: np.empty(shape, dtype) for name, (shape, dtype) in layout.items()})


class MappedColumns:
    """Columns in files of full length, most of it holes.

    A store into a hole of a full disk is answered with SIGBUS, so `back` has the disk fill the holes first.

    Attributes:
        columns: plain arrays over the files.
    """

    def __init__(self, directory: Path, columns: Columns) -> None:
        """Use `open`."""
        self.columns = columns
        self._paths = {column.name: directory / f"{column.name}.bin" for column in fields(columns)}
        self._rows = len(columns.reward)
        self._chunk = max(1, CHUNK_BYTES // sum(self._row_bytes(name) for name in self._paths))

    @classmethod
    def open(
        cls, directory: Path, rows: int, observation_dim: int, action_dim: int, *, new: bool
    ) -> MappedColumns:
        """The columns in `directory`.

        Args:
            directory: is there.
            rows: of the ring.
            observation_dim: of a row.
            action_dim: of a row.
            new: nothing in the files counts, so they may be missing.

        Raises:
            ValueError: a file is missing or has another size.
            OSError: one cannot be read or made.
        """
        columns = {}
        for name, (shape, dtype) in _layout(rows, observation_dim, action_dim).items():
            path, size = directory / f"{name}.bin", int(np.prod(shape)) * np.dtype(dtype).itemsize
            if new:
                with path.open("ab") as file:
                    file.truncate(size)
            elif not path.is_file():
                raise ValueError(f"{path}: missing")
            elif path.stat().st_size != size:
                raise ValueError(f"{path}: {path.stat().st_size} bytes (wanted {size})")
            # A plain view: indexing a memmap object is slower.
            columns[name] = np.asarray(np.memmap(path, dtype, "r+", shape=shape))
        return cls(directory, Columns(**columns))

    def back(self, row: int) -> int:
        """Take the disk's place for rows from `row` on; returns the first row that may have none yet.

        The rows of a chunk have it together, so a ring that was opened again needs none for the one it is in.

        Raises:
            OSError: there is no place, or none for a file of this size.
        """
        begin = row // self._chunk * self._chunk
        end = min(begin + self._chunk, self._rows)
        for name, path in self._paths.items():
            size = self._row_bytes(name)
            descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
            try:
                os.posix_fallocate(descriptor, begin * size, (end - begin) * size)
            finally:
                os.close(descriptor)
        return end

    def sync(self) -> None:
        """Put everything stored so far on the disk. For any thread; learning goes on meanwhile.

        Raises:
            OSError: it is not there.
        """
        for path in self._paths.values():
            descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
            try:
                os.fdatasync(descriptor)  # of the file, so of its mapped pages too; frees the interpreter
            finally:
                os.close(descriptor)

    def _row_bytes(self, name: str) -> int:
        column = getattr(self.columns, name)
        return int(column.nbytes) // self._rows


def _layout(
    rows: int, observation_dim: int, action_dim: int
) -> dict[str, tuple[tuple[int, ...], type[np.generic]]]:
    return {
        "observation": ((rows, observation_dim), np.float32),
        "action": ((rows, action_dim), np.float32),
        "reward": ((rows,), np.float32),
        "next_observation": ((rows, observation_dim), np.float32),
        "terminated": ((rows,), np.bool_),
        "unit": ((rows,), np.int32),
    }
