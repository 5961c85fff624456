"""What the passing of run time asks of the learner: pure, no clock of its own.

Feed it the run time; it says which units ended, which windows and phases began, and when an iterate
is due for publication.
"""

from __future__ import annotations

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
    """

    def __init__(self, windows: WindowClock) -> None:
        self._windows = windows
        self._unit: int | None = None
        self._window: int | None = None
        self._shown: tuple[int, Phase] | None = None  # window and phase, as last announced
        self._settled = (-1, 0)  # newest iterate that was due: (window, g)
        self._paused = False
        self.position: Position | None = None

    @property
    def improving(self) -> bool:
        """Whether the policy is to be improved now."""
        return self.position is not None and self.position.phase == "update" and not self._paused

    def pause(self, run_time_ns: int) -> list[Happening]:
        """An operator's hold: no improvement and nothing published until `resume`."""
        if self._paused:
            return []
        self._paused = True
        return self._phase_change(run_time_ns, "operator")

    def resume(self, run_time_ns: int) -> list[Happening]:
        """Back to what the schedule says."""
        if not self._paused:
            return []
        self._paused = False
        return self._phase_change(run_time_ns, "operator")

    def advance(self, run_time_ns: int, lead_ns: int) -> list[Happening]:
        """Everything that happened since the last call, in order."""
        previous, now = self.position, self._windows.position(run_time_ns)
        self.position = now
        found: list[Happening] = []
        if previous is not None:
            found += [UnitEnded(unit) for unit in range(previous.unit, now.unit)]
            found += self._overdue(previous, now)
        if self._window != now.window.m:
            self._window = now.window.m
            found.append(WindowEntered(now.window, now.unit))
        found += self._phase_change(now.phase_start_ns if previous is not None else run_time_ns, "schedule")
        if self.improving and run_time_ns >= now.unit_end_ns - lead_ns:
            iterate = (now.window.m, now.iterate)
            if iterate > self._settled:
                self._settled = iterate
                found.append(PublishDue(now.window, now.iterate))
        return found

    def _overdue(self, previous: Position, now: Position) -> list[Happening]:
        """The iterate of the unit left behind, if its publication was never due while it ran."""
        iterate = (previous.window.m, previous.iterate)
        left = (now.window.m, now.unit) != (previous.window.m, previous.unit)
        if not left or previous.phase != "update" or iterate <= self._settled:
            return []
        self._settled = iterate
        return [PublishMissed(previous.window, previous.iterate)]

    def _phase_change(self, start_ns: int, reason: Literal["schedule", "operator"]) -> list[Happening]:
        if self.position is None:
            return []
        phase: Phase = "hold" if self._paused else self.position.phase
        shown = (self.position.window.m, phase)
        if shown == self._shown:
            return []
        self._shown = shown
        return [PhaseEntered(self.position.window, phase, start_ns, reason)]
