"""What acted when, in a finite world: the policies, the forecasts behind them and the ticks of each.

From this file and the run's configuration the exact regret of a run can be computed afterwards. Whoever sends
the policies writes; the training thread counts, puts into a queue, and writes the ticks of a unit as it ends.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from learner.entries import (
    FALLBACK,
    LENGTH_BYTES,
    NAME,
    Acted,
    ActedIn,
    Contents,
    Entered,
    Entry,
    Forecast,
    Published,
    read,
)
from rtcore.clock import Clock
from rtcore.ledger import Ledger
from rtcore.messages import Policy, Spec, Step, WindowNotice
from rtcore.weights import unpack
from rtcore.windows import Window

__all__ = [
    "FALLBACK", "NAME", "Acted", "ActedIn", "Contents", "Entered", "Entry", "Forecast", "Published", "read",
]  # fmt: skip

# A unit may be long: what a kill takes along is one unit, or so many ticks if they are fewer.
MOST_TICKS = 1000


class Tally:
    """Counts one environment's ticks by policy, unit by unit. Pure.

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
        self._tallies: dict[str, Tally] = {}  # by environment; none in a continuous world
        self._size = self._t0_ns = 0

    @property
    def pending(self) -> dict[str, Acted]:
        """What was lived and is not written yet, by environment: give it to `meet` of a later learner."""
        found = {env: tally.pending for env, tally in self._tallies.items()}
        return {env: pending for env, pending in found.items() if pending is not None}

    def meet(self, spec: Spec, envs: Collection[str], pending: Mapping[str, Acted]) -> None:
        """Learn what world it is, and the environments of the run; go on after what an earlier learner of it
        wrote or had `pending`."""
        if not spec.states:
            return
        try:
            found = read(self._path)
        except OSError as error:  # what cannot be read is not written to either
            self._complain(error)
            return
        self._ledger.count("diary.torn", found.torn)
        self._size, self._t0_ns = found.size, spec.t0_ns
        told = dict.fromkeys(envs, (-1, 0))
        for one in found.entries:
            if isinstance(one, Acted):
                env = one.env if isinstance(one, ActedIn) else next(iter(envs))
                told[env] = max(told.get(env, (-1, 0)), (one.incarnation, one.next_seq))
        self._tallies = {env: Tally(told[env], pending.get(env)) for env in envs}

    def acted(self, steps: Sequence[Step]) -> None:
        """Count what was lived, each step once and those of an environment in order; write what is not
        `pending` any more."""
        for env, tally in self._tallies.items():
            self._tell(env, tally.take([step for step in steps if step.env == env]))

    def window(self, window: Window, unit: int, algorithm: object) -> None:
        """A window was entered in `unit`, and `algorithm` has begun it."""
        if not self._tallies or not isinstance(algorithm, Forecasting):
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
        if not self._tallies:
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
        for env, tally in self._tallies.items():
            self._tell(env, tally.finish())

    def flush(self) -> None:
        """Write all that waits. For any thread."""
        with self._writing:
            while True:
                try:
                    entry = self._waiting.get_nowait()
                except Empty:
                    return
                self._write(entry)

    def _tell(self, env: str, told: Sequence[Acted]) -> None:
        """Write the ticks of one environment, with its name if there are others."""
        if not told:
            return
        if len(self._tallies) > 1:
            told = [ActedIn(env=env, **msgspec.structs.asdict(one)) for one in told]
        self._put(told)
        self.flush()

    def _put(self, entries: Sequence[Entry]) -> None:
        for entry in entries:
            self._waiting.put(entry)

    def _write(self, entry: Entry) -> None:
        """Append one entry whole, or leave the file as it was."""
        body = msgspec.msgpack.encode(entry)
        data = len(body).to_bytes(LENGTH_BYTES, "little") + body
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
