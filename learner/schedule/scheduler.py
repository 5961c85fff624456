"""The learner's schedule at work: it chooses, says why, obeys an operator and outlives the learner."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from learner.algorithm import Algorithm
from learner.schedule.choosing import Choice, by_bound, by_forecasts, fall_back
from learner.schedule.timetable import Timetable
from rtcore.clock import Clock
from rtcore.config import RunConfig, ScheduleConfig
from rtcore.config_check import check
from rtcore.ledger import Ledger
from rtcore.windows import Position, Window, WindowClock


class Scheduler:
    """Owns the timetable. One thread, the learner's, calls it.

    Attributes:
        windows: the timetable as a clock.
    """

    def __init__(
        self, config: RunConfig, clock: Clock, ledger: Ledger, keep: Callable[[bytes], None]
    ) -> None:
        """`keep` is given the timetable whenever it cannot be told from the configuration alone."""
        self._config = config
        self._clock = clock
        self._ledger = ledger
        self._keep = keep
        self._algorithm: Algorithm | None = None
        self._made: Choice | None = None  # of the window that is about to be entered
        self._timetable = Timetable(config.learner.schedule, self._choose)
        self.windows = WindowClock(self._timetable, round(config.env.unit_s * 1e9))

    def meet(self, algorithm: Algorithm, kept: bytes | None) -> None:
        """The algorithm to ask, and the timetable of an earlier learner of the run, if there was one."""
        self._algorithm = algorithm
        if kept is None:
            return
        try:
            began = self._timetable.load(kept)
        except ValueError as error:
            text = f"the timetable on disk is damaged, windows go on as configured: {error}"
            self._ledger.event(self._clock.now_ns(), "WARN", text)
            return
        if began != self._config.learner.schedule:
            text = "windows go on by the timetable of the learner before, not as configured now: "
            self._ledger.event(self._clock.now_ns(), "WARN", text + "`tenuto schedule` changes them")

    def entered(self, window: Window) -> None:
        """A window was entered: put it on the timeline, with why it is as it is."""
        self._show(window)
        choice, self._made = self._made, None
        if choice is None:
            return
        text = f"window {window.m}: {window.update} units of update, {window.hold} of hold: {choice.why}"
        self._ledger.event(self._clock.now_ns(), "INFO", text)
        for name in ("predicted", "unheld", "trust"):
            if not math.isnan(value := getattr(choice, name)):
                self._ledger.gauge(f"schedule/{name}", value)
        self._keep(self._timetable.dump())

    def check(self, schedule: ScheduleConfig) -> None:
        """Whether this run could go by another schedule. From any thread.

        Raises:
            ConfigError: it could not.
        """
        check(replace(self._config, learner=replace(self._config.learner, schedule=schedule)))
        Timetable(schedule, self._choose)

    def change(self, schedule: ScheduleConfig, position: Position) -> str:
        """Go by another schedule, which was checked, after the present window; says from when."""
        unit = self._timetable.change(schedule, position.window, position.unit)
        self._show(self._timetable.window_at(position.unit))  # one without end has one now
        self._keep(self._timetable.dump())
        return f"schedule {schedule.kind} from unit {unit} on"

    def _show(self, window: Window) -> None:
        self._ledger.gauge("schedule/update", window.update)
        self._ledger.gauge("schedule/hold", math.nan if window.hold is None else window.hold)

    def _choose(self, schedule: ScheduleConfig, start: int) -> int:
        assert self._algorithm is not None, "a window begins before the world is known"
        outlook = self._algorithm.outlook(start, schedule.l_f)
        needed = self._config.learner.forecast.l_p
        known = 0 if outlook is None else len(outlook.past)
        if outlook is None or known < needed:
            self._made = fall_back(schedule, known, needed)
        elif schedule.kind == "auto":
            self._made = by_forecasts(schedule, outlook)
        else:
            self._made = by_bound(schedule, outlook, self._config.learner)
        return self._made.update
