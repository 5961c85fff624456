"""When the policy is updated and when it is held: the paper's windows, as pure functions of time.

Unit t is [t, t+1) * unit_ns of run time. Window m is [t_m, t_{m+1}) units: an update phase of G_m units,
then a hold of N_m. Everything is half-open and counted in integers, so an instant has exactly one window,
one phase and one unit.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

from rtcore.config import ConfigError, Rounding, ScheduleConfig
from rtcore.messages import Phase

# l_f * gamma_f is a product of decimals: 20 * 0.15 or 15 * 0.6 may land 2e-15 beside the integer that is
# meant. 1e-9 is far above that error and far below any share that a person writes.
PRODUCT_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Window:
    """Window m = [start, end) units: `update` units of updating, then `hold` units of holding.

    Attributes:
        m: index of the window, from 0.
        start: t_m in units.
        update: G_m >= 1 in units.
        hold: N_m >= 0 in units; None: the window never ends (the last one of an explicit schedule).
    """

    m: int
    start: int
    update: int
    hold: int | None

    @property
    def hold_start(self) -> int:
        """t_m + G_m, the first unit that is not updated in."""
        return self.start + self.update

    @property
    def end(self) -> int | None:
        """t_{m+1} in units, or None."""
        return None if self.hold is None else self.start + self.update + self.hold


class Schedule(Protocol):
    """Which window a unit lies in."""

    def window_at(self, t: int) -> Window:
        """The window m with t_m <= t < t_{m+1}.

        Raises:
            ValueError: t < 0.
        """


def update_units(l_f: int, gamma_f: float, rounding: Rounding) -> int:
    """G of a window of `l_f` units of which the share `gamma_f` is updated: at least 1, at most l_f.

    `floor` is the paper's text (section 6, t_m + floor(l_f gamma_f)), raised to 1 where it would be 0;
    `ceil` is the authors' code; `paper_le` is the condition of Algorithm 2 as printed, which counts the
    i in 0..l_f-1 with i <= l_f * gamma_f.
    """
    share = l_f * gamma_f
    whole = math.floor(share + PRODUCT_TOLERANCE)
    units: dict[Rounding, int] = {
        "floor": whole,
        "ceil": math.ceil(share - PRODUCT_TOLERANCE),
        "paper_le": whole + 1,
    }
    return min(max(units[rounding], 1), l_f)


class FixedSchedule:
    """Windows of equal length: t_m = l_f * m.

    Raises:
        ConfigError: l_f < 1, gamma_f outside (0, 1], or an unknown rounding.
    """

    def __init__(self, l_f: int, gamma_f: float, rounding: Rounding = "floor") -> None:
        if l_f < 1:
            raise ConfigError("learner.schedule.l_f", l_f, "must be an integer >= 1")
        if not 0 < gamma_f <= 1:
            raise ConfigError("learner.schedule.gamma_f", gamma_f, "must be in (0, 1]")
        if rounding not in ("floor", "ceil", "paper_le"):
            raise ConfigError(
                "learner.schedule.rounding", rounding, "must be one of 'floor', 'ceil', 'paper_le'"
            )
        self._length = l_f
        self._update = update_units(l_f, gamma_f, rounding)

    def window_at(self, t: int) -> Window:
        """See `Schedule`. O(1)."""
        m = _checked_unit(t) // self._length
        return Window(m, m * self._length, self._update, self._length - self._update)


class ExplicitSchedule:
    """Windows that start at the listed units t_m, each updated for its own G_m.

    The last window has no end: it is updated for its G and then held for good.

    Raises:
        ConfigError: nothing listed, t_0 != 0, not rising, lengths that differ, G_m < 1, or a window whose
            updates reach past the start of the next.
    """

    def __init__(self, t_m: tuple[int, ...], g_m: tuple[int, ...]) -> None:
        _check_starts(t_m)
        _check_updates(t_m, g_m)
        self._starts = t_m
        self._updates = g_m

    def window_at(self, t: int) -> Window:
        """See `Schedule`. O(log n)."""
        m = bisect_right(self._starts, _checked_unit(t)) - 1
        start, update = self._starts[m], self._updates[m]
        hold = self._starts[m + 1] - start - update if m + 1 < len(self._starts) else None
        return Window(m, start, update, hold)


def make_schedule(config: ScheduleConfig) -> Schedule:
    """The schedule that the section `learner.schedule` declares; of a kind whose windows the learner
    decides about, the fixed one that they fall back to.

    Raises:
        ConfigError: it declares none.
    """
    match config.kind:
        case "explicit":
            return ExplicitSchedule(config.t_m, config.g_m)
        case "live":
            return FixedSchedule(1, 1.0)
        case "fixed" | "optimal" | "auto" | "auto_bound":
            return FixedSchedule(config.l_f, config.gamma_f, config.rounding)


@dataclass(frozen=True, slots=True)
class Position:
    """Where an instant of run time lies.

    Attributes:
        window: the window it is in.
        unit: t.
        iterate: g. In the update phase the iterate in the making, due at the end of this unit (1..G);
            in the hold G, the one that is held.
        phase: update or hold.
        phase_start_ns: run time at which the phase began.
        phase_end_ns: run time at which it ends; None: never.
        unit_end_ns: run time at which the unit ends.
    """

    window: Window
    unit: int
    iterate: int
    phase: Phase
    phase_start_ns: int
    phase_end_ns: int | None
    unit_end_ns: int


class WindowClock:
    """Reads a schedule as a clock: run time in nanoseconds in, window and phase out.

    Raises:
        ValueError: unit_ns < 1.
    """

    def __init__(self, schedule: Schedule, unit_ns: int) -> None:
        if unit_ns < 1:
            raise ValueError(f"unit_ns = {unit_ns}: must be >= 1")
        self._schedule = schedule
        self._unit_ns = unit_ns

    def position(self, run_time_ns: int) -> Position:
        """Where `run_time_ns` (since T0) lies. The instant (t_m + G_m) * unit_ns itself is hold.

        Raises:
            ValueError: run_time_ns < 0.
        """
        if run_time_ns < 0:
            raise ValueError(f"run_time_ns = {run_time_ns}: the run begins at 0")
        t = run_time_ns // self._unit_ns
        window = self._schedule.window_at(t)
        updating = t < window.hold_start
        start, end = (window.start, window.hold_start) if updating else (window.hold_start, window.end)
        return Position(
            window=window,
            unit=t,
            iterate=t - window.start + 1 if updating else window.update,
            phase="update" if updating else "hold",
            phase_start_ns=start * self._unit_ns,
            phase_end_ns=None if end is None else end * self._unit_ns,
            unit_end_ns=(t + 1) * self._unit_ns,
        )


def _checked_unit(t: int) -> int:
    if t < 0:
        raise ValueError(f"t = {t}: units count from 0")
    return t


def _check_starts(t_m: tuple[int, ...]) -> None:
    name = "learner.schedule.t_m"
    if not t_m:
        raise ConfigError(name, t_m, "must list at least one window start")
    if t_m[0] != 0:
        raise ConfigError(name, t_m, "must start with 0")
    if any(after <= before for before, after in pairwise(t_m)):
        raise ConfigError(name, t_m, "must rise")


def _check_updates(t_m: tuple[int, ...], g_m: tuple[int, ...]) -> None:
    name = "learner.schedule.g_m"
    if len(g_m) != len(t_m):
        raise ConfigError(name, g_m, f"must have one entry for each of the {len(t_m)} window starts t_m")
    if any(updates < 1 for updates in g_m):
        raise ConfigError(name, g_m, "must be >= 1 each")
    for m, (start, after) in enumerate(pairwise(t_m)):
        if start + g_m[m] > after:
            raise ConfigError(
                name, g_m, f"entry {m} must be <= {after - start}, the length of window [{start}, {after})"
            )
