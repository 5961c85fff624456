"""What the passing of run time asks of the learner: pure, no clock of its own.

Feed it the run time; it says which units ended, which windows and phases began, and when an iterate
is due for publication.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from rtcore.messages import Phase
from rtcore.windows import Position, Window, WindowClock


@dataclass(frozen=True, slots=True)
class UnitEnded:
    """Unit `unit` is over."""

    unit: int


@dataclass(frozen=True, slots=True)
class WindowEntered:
    """A window began, or was entered midway after a late start; `unit` is the one that runs now."""

    window: Window
    unit: int


@dataclass(frozen=True, slots=True)
class PhaseEntered:
    """A phase began at run time `start_ns`, by the schedule or by an operator's order."""

    window: Window
    phase: Phase
    start_ns: int
    reason: Literal["schedule", "operator"]


@dataclass(frozen=True, slots=True)
class PublishDue:
    """Iterate g of the window is due: its unit ends within the lead."""

    window: Window
    iterate: int


@dataclass(frozen=True, slots=True)
class PublishMissed:
    """Iterate g of the window could not be published before its time was over."""

    window: Window
    iterate: int


Happening = UnitEnded | WindowEntered | PhaseEntered | PublishDue | PublishMissed


class Conductor:
    """Walks through the windows by the run time that it is told.

    A unit's iterate is due `lead_ns` before the unit ends, so that its stamp is within the unit and,
    for the last one, within the update phase (stamp <= t_m + G_m).

    Attributes:
        position: where the run time told last lies.
        settled: newest unit whose iterate was due or missed: it will not be again. Not (window, g): another
            schedule numbers its windows anew.
    """

    def __init__(self, windows: WindowClock) -> None:
        self._windows = windows
        self._shown: tuple[Window, Phase] | None = None  # as last announced
        self.settled = -1
        self._paused = False
        self._worked = False  # the policy was to be improved at some time of the present unit
        self.position: Position | None = None

    @property
    def improving(self) -> bool:
        """Whether the policy is to be improved now."""
        return self.position is not None and self.position.phase == "update" and not self._paused

    @property
    def paused(self) -> bool:
        """Whether an operator holds the policy."""
        return self._paused

    def go_on_from(self, settled: int, *, paused: bool) -> None:
        """Go on after an earlier learner of the run. Call it before the first `advance`."""
        self.settled = max(self.settled, settled)
        self._paused = paused

    def pause(self, run_time_ns: int) -> list[Happening]:
        """An operator's hold: no improvement and nothing published until `resume`."""
        self._paused = True
        return self._phase_change(run_time_ns, "operator")

    def rescheduled(self, run_time_ns: int) -> list[Happening]:
        """The present window, which had no end, was given one: tell it as it is now."""
        if self.position is None:
            return []
        self.position = self._windows.position(min(run_time_ns, self.position.unit_end_ns - 1))
        return self._phase_change(run_time_ns, "operator" if self._paused else "schedule")

    def resume(self, run_time_ns: int) -> list[Happening]:
        """Back to what the schedule says."""
        self._paused = False
        self._worked |= self.improving
        return self._phase_change(run_time_ns, "operator")

    def advance(self, run_time_ns: int, lead_ns: int) -> Iterator[Happening]:
        """Everything that happened since the last call, in order: after a stall, every unit by itself.

        What a window will be is asked of the schedule only once all that happened before it has been
        taken from the iterator: a schedule may decide by what was learned until then. Take everything.
        """
        while self.position is not None and self.position.unit_end_ns <= run_time_ns:
            yield from self._leave(self.position)
            yield from self._enter(self.position.unit_end_ns)
        if self.position is None:
            yield from self._enter(run_time_ns)
        assert self.position is not None
        unit, end_ns = self.position.unit, self.position.unit_end_ns
        if self.improving and unit > self.settled and run_time_ns >= end_ns - lead_ns:
            self.settled = unit
            yield PublishDue(*iterate_of(self.position))

    def _leave(self, position: Position) -> Iterator[Happening]:
        """The unit that `position` is in is over."""
        yield UnitEnded(position.unit)
        if position.phase == "update" and position.unit > self.settled:
            self.settled = position.unit
            if self._worked:  # a unit that an operator held throughout misses nothing
                yield PublishMissed(*iterate_of(position))

    def _enter(self, run_time_ns: int) -> Iterator[Happening]:
        """Go to the unit that `run_time_ns` is in: the one after the present one, or the first one."""
        previous, now = self.position, self._windows.position(run_time_ns)
        self.position = now
        self._worked = self.improving
        if previous is None or previous.window.m != now.window.m:
            yield WindowEntered(now.window, now.unit)
        yield from self._phase_change(run_time_ns, "operator" if self._paused else "schedule")

    def _phase_change(self, start_ns: int, reason: Literal["schedule", "operator"]) -> list[Happening]:
        if self.position is None:
            return []
        phase: Phase = "hold" if self._paused else self.position.phase
        if phase == self.position.phase == "hold":
            reason = "schedule"  # an operator's order changes nothing here
        shown = (self.position.window, phase)
        if shown == self._shown:
            return []
        self._shown = shown
        return [PhaseEntered(self.position.window, phase, start_ns, reason)]


def iterate_of(position: Position) -> tuple[Window, int]:
    """The window and g that `position` is in."""
    return position.window, position.iterate
