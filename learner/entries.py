"""The entries of a learner's diary, and how the file is read; `learner.diary` writes it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from rtcore.messages import Phase

NAME = "diary.msgpack"  # in the learner's directory
FALLBACK = -1  # in place of a policy's version: nobody's answer acted
LENGTH_BYTES = 4  # in front of each entry, little-endian


class _Entry(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """New fields go last and have defaults."""


class Published(_Entry, frozen=True, kw_only=True, tag="policy"):
    """A policy went out."""

    version: int
    window: int
    iterate: int
    created_ns: int
    states: int
    actions: int
    table: bytes  # float32 [states, actions], little-endian: the probabilities as agents got them

    @property
    def probability(self) -> NDArray[np.float64]:
        """[S, A], as an agent draws from it: rows that sum to 1."""
        table = np.frombuffer(self.table, "<f4").reshape(self.states, self.actions).astype(np.float64)
        rows: NDArray[np.float64] = table / table.sum(-1, keepdims=True)
        return rows


class Forecast(_Entry, frozen=True, kw_only=True, tag="window"):
    """A window was entered by a learner that improves its policy towards a forecast."""

    window: int
    start: int  # t_m
    update: int
    hold: int | None
    unit: int  # t_m, or where it was entered late
    states: int
    actions: int
    forecast: bytes  # float64 [states, actions], little-endian: Qtilde as it is used
    log_policy: bytes  # likewise: log pi, before the window's first iteration

    def tables(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Qtilde and log pi, [S, A] each."""
        shape = (self.states, self.actions)
        forecast, log_policy = (
            np.frombuffer(data, "<f8").reshape(shape) for data in (self.forecast, self.log_policy)
        )
        return forecast, log_policy


class Entered(_Entry, frozen=True, kw_only=True, tag="phase"):
    """A phase began, by the schedule or by an operator's order."""

    window: int
    phase: Phase
    run_ns: int  # since T0


class Acted(_Entry, frozen=True, kw_only=True, tag="acted"):
    """Ticks of one unit, by the policy that acted; a unit may have several entries, which add up."""

    incarnation: int  # of the env server
    next_seq: int  # of its first step that is in no entry yet
    unit: int
    ticks: dict[int, int]  # by version, `FALLBACK` for misses


class ActedIn(Acted, frozen=True, kw_only=True, tag="acted_in"):
    """The same, of one environment of a fleet."""

    env: str


Entry = Published | Forecast | Entered | Acted | ActedIn
_DECODER = msgspec.msgpack.Decoder(Entry)


class Contents(NamedTuple):
    """A diary, read."""

    entries: list[Entry]
    torn: int  # 1: something follows that is no whole entry, as a kill or a full disk leaves it
    size: int  # bytes of the whole entries


def read(path: Path) -> Contents:
    """All whole entries of a diary; nothing if there is none.

    Raises:
        OSError: it cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return Contents([], 0, 0)
    entries: list[Entry] = []
    size = 0
    while size < len(data):
        begin = size + LENGTH_BYTES
        end = begin + int.from_bytes(data[size:begin], "little")
        try:
            entry = _DECODER.decode(data[begin:end]) if end <= len(data) else None
        except (ValueError, RecursionError):
            entry = None
        if entry is None:
            break
        entries.append(entry)
        size = end
    return Contents(entries, int(size < len(data)), size)
