"""What acted when, in a finite world: the policies, the forecasts behind them and the ticks of each.

From this file and the run's configuration the exact regret of a run can be computed afterwards. Whoever sends
the policies writes; the training thread counts, puts into a queue, and writes the ticks of a unit as it ends.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple, Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from rtcore.clock import Clock
from rtcore.ledger import Ledger
from rtcore.messages import Phase, Policy, Spec, Step, WindowNotice
from rtcore.weights import unpack
from rtcore.windows import Window

NAME = "diary.msgpack"  # in the learner's directory
FALLBACK = -1  # in place of a policy's version: nobody's answer acted
# A unit may be long: what a kill takes along is one unit, or so many ticks if they are fewer.
MOST_TICKS = 1000
_LENGTH_BYTES = 4  # in front of each entry, little-endian


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


Entry = Published | Forecast | Entered | Acted
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
        begin = size + _LENGTH_BYTES
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


class Tally:
    """Counts ticks by policy, unit by unit. Pure.

    Args:
        position: (incarnation, seq) before which everything is counted already.
        pending: what an earlier one had not told.
    """

    def __init__(self, position: tuple[int, int] = (-1, 0), pending: Acted | None = None) -> None:
        self._position = position
        self._unit: tuple[int, int] | None = None  # of what is counted but not told yet: incarnation, unit
        self._ticks: Counter[int] = Counter()
        if pending is not None and (reached := (pending.incarnation, pending.next_seq)) > position:
            self._position, self._unit = reached, (pending.incarnation, pending.unit)
            self._ticks.update(pending.ticks)

    @property
    def pending(self) -> Acted | None:
        """What is counted but not told yet."""
        if self._unit is None:
            return None
        incarnation, seq = self._position
        return Acted(incarnation=incarnation, next_seq=seq, unit=self._unit[1], ticks=dict(self._ticks))

    def take(self, steps: Sequence[Step]) -> list[Acted]:
        """Count steps, in order; returns what is complete. A reset counts nothing: no action was taken."""
        told: list[Acted] = []
        for step in steps:
            if (step.incarnation, step.seq) < self._position:
                continue
            if self._unit not in (None, (step.incarnation, step.unit)):
                told += self.finish()
            self._position = (step.incarnation, step.seq + 1)
            if step.episode_tick == 0:
                continue
            self._unit = step.incarnation, step.unit
            self._ticks[FALLBACK if step.missed else step.policy_version] += 1
            if self._ticks.total() >= MOST_TICKS:
                told += self.finish()
        return told

    def finish(self) -> list[Acted]:
        """What is left."""
        told = [] if self.pending is None else [self.pending]
        self._unit = None
        self._ticks.clear()
        return told


@runtime_checkable
class Forecasting(Protocol):
    """An algorithm whose windows have a bound."""

    def window_start(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Qtilde as it is used in this window and log pi as it is now, [S, A] each; None without a window."""


class Diary:
    """Writes the diary of a finite world, and nothing in a continuous one.

    `flush` writes, and `acted` once a unit; all else puts into a queue and never waits. Counts `diary.errors`
    (entries that did not fit on the disk) and `diary.torn`. An entry is in the operating system's hands once
    it is written, so a kill of this process loses none of those; the machine's end may.
    """

    def __init__(self, path: Path, clock: Clock, ledger: Ledger) -> None:
        self._path = path
        self._clock, self._ledger = clock, ledger
        self._waiting: SimpleQueue[Entry] = SimpleQueue()
        self._writing = threading.Lock()
        self._tally: Tally | None = None
        self._size = self._t0_ns = 0

    @property
    def pending(self) -> Acted | None:
        """What was lived and is not written yet: give it to `meet` of a later learner."""
        return None if self._tally is None else self._tally.pending

    def meet(self, spec: Spec, pending: Acted | None = None) -> None:
        """Learn what world it is; go on after what an earlier learner of the run wrote or had `pending`."""
        if not spec.states:
            return
        try:
            found = read(self._path)
        except OSError as error:  # what cannot be read is not written to either
            self._complain(error)
            return
        self._ledger.count("diary.torn", found.torn)
        self._size, self._t0_ns = found.size, spec.t0_ns
        told = ((one.incarnation, one.next_seq) for one in found.entries if isinstance(one, Acted))
        self._tally = Tally(max(told, default=(-1, 0)), pending)

    def acted(self, steps: Sequence[Step]) -> None:
        """Count what was lived, each step once and in order; write what is not `pending` any more."""
        if self._tally is not None:
            self._put(self._tally.take(steps), at_once=True)

    def window(self, window: Window, unit: int, algorithm: object) -> None:
        """A window was entered in `unit`, and `algorithm` has begun it."""
        if self._tally is None or not isinstance(algorithm, Forecasting):
            return
        tables = algorithm.window_start()
        if tables is not None:
            forecast, log_policy = tables
            entry = Forecast(
                window=window.m, start=window.start, update=window.update, hold=window.hold, unit=unit,
                states=forecast.shape[0], actions=forecast.shape[1],
                forecast=forecast.astype("<f8").tobytes(), log_policy=log_policy.astype("<f8").tobytes(),
            )  # fmt: skip
            self._put([entry])

    def sent(self, message: Policy | WindowNotice) -> None:
        """A policy or a notice went out."""
        if self._tally is None:
            return
        if isinstance(message, WindowNotice):
            run_ns = message.at_ns - self._t0_ns
            self._put([Entered(window=message.window, phase=message.phase, run_ns=run_ns)])
            return
        architecture, table = message.architecture, unpack(message.weights)["probability"]
        entry = Published(
            version=message.version, window=message.window, iterate=message.iterate,
            created_ns=message.created_ns, states=architecture.states, actions=architecture.actions,
            table=table.astype("<f4").tobytes(),
        )  # fmt: skip
        self._put([entry])

    def finish(self) -> None:
        """Nothing more will be lived: write what is left."""
        if self._tally is not None:
            self._put(self._tally.finish(), at_once=True)

    def flush(self) -> None:
        """Write all that waits. For any thread."""
        with self._writing:
            while True:
                try:
                    entry = self._waiting.get_nowait()
                except Empty:
                    return
                self._write(entry)

    def _put(self, entries: Sequence[Entry], *, at_once: bool = False) -> None:
        for entry in entries:
            self._waiting.put(entry)
        if at_once and entries:
            self.flush()

    def _write(self, entry: Entry) -> None:
        """Append one entry whole, or leave the file as it was."""
        body = msgspec.msgpack.encode(entry)
        data = len(body).to_bytes(_LENGTH_BYTES, "little") + body
        try:
            with self._path.open("ab", buffering=0) as file:
                file.truncate(self._size)  # a kill or a full disk may have left a part of an entry
                if file.write(data) < len(data):
                    raise OSError("only a part of an entry was written")
        except OSError as error:
            self._complain(error)
        else:
            self._size += len(data)

    def _complain(self, error: OSError) -> None:
        self._ledger.count("diary.errors")
        if self._ledger.counter("diary.errors") == 1:
            text = f"no exact regret of what follows: {error}"
            self._ledger.event(self._clock.now_ns(), "WARN", text)
