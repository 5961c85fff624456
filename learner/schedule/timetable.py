"""The windows of a run, although some are decided as they begin and an operator may change the rest."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import msgspec

from learner.theory.optimum import HoldProblem, best_split
from rtcore.config import ConfigError, ScheduleConfig
from rtcore.windows import FixedSchedule, Schedule, Window, make_schedule

Choose = Callable[[ScheduleConfig, int], int]
"""G of the window of `l_f` units that begins at t_m; in 1 .. l_f."""


class ChosenSchedule:
    """Windows of W units; G is asked for when a window is first looked at, and stays."""

    def __init__(self, length: int, choose: Callable[[int], int]) -> None:
        """`choose` is given t_m."""
        self._length = length
        self._choose = choose
        self.chosen: dict[int, int] = {}  # G of the newest two windows, by m

    def window_at(self, t: int) -> Window:
        """See `Schedule`."""
        m = t // self._length
        start = m * self._length
        if m not in self.chosen:
            update = self._choose(start)
            newest = list(self.chosen.items())[-1:]
            self.chosen = dict([*newest, (m, update)])
        return Window(m, start, self.chosen[m], self._length - self.chosen[m])


@dataclass(frozen=True, slots=True)
class Section:
    """From unit `start` on, and from window `m` on, windows are as `schedule`, which `config` describes."""

    start: int
    m: int
    config: ScheduleConfig
    schedule: Schedule


class Timetable:
    """A schedule that can be replaced while it runs: what has begun stays, what comes is new."""

    def __init__(self, config: ScheduleConfig, choose: Choose) -> None:
        """
        Args:
            config: checked.
            choose: asked for the windows of a kind that chooses.
        """
        self._choose = choose
        self._sections = [self._section(0, 0, config)]

    def window_at(self, t: int) -> Window:
        """See `Schedule`."""
        index = max(i for i, section in enumerate(self._sections) if i == 0 or section.start <= t)
        section = self._sections[index]
        found = section.schedule.window_at(t - section.start)
        shifted = replace(found, m=found.m + section.m, start=found.start + section.start)
        return shifted if index + 1 == len(self._sections) else cut(shifted, self._sections[index + 1].start)

    def change(self, config: ScheduleConfig, window: Window, unit: int) -> int:
        """Go by another schedule once `window`, the present one, has ended; if it never ends, from the unit
        after the present one on. An earlier change that has not come into force is forgotten.

        Returns:
            The unit from which it holds, which is 0 to the new schedule.
        """
        start = unit + 1 if window.end is None else window.end
        kept = [section for section in self._sections if section.start < start]
        self._sections = [*kept, self._section(start, window.m + 1, config)]
        return start

    # -- durability

    def dump(self) -> bytes:
        """What a later learner of the run needs to go on by the same windows."""
        sections = [
            {
                "start": section.start,
                "m": section.m,
                "config": asdict(section.config),
                "chosen": list(_chosen(section.schedule).items()),
            }
            for section in self._sections
        ]
        return json.dumps(sections).encode()

    def load(self, data: bytes) -> ScheduleConfig:
        """Go on by what an earlier `dump` of the same run says.

        Returns:
            What the run began with.

        Raises:
            ValueError: it is not whole; nothing has changed then.
        """
        try:
            sections = [self._loaded(found) for found in json.loads(data)]
        except (KeyError, TypeError, OverflowError, RecursionError) as error:
            raise ValueError(f"not a timetable: {error!r}") from error
        if not sections or sections[0].start != 0:
            raise ValueError("not a timetable: it must begin at unit 0")
        if any(after.start <= one.start or after.m <= one.m for one, after in pairwise(sections)):
            raise ValueError("not a timetable: its sections must rise")
        self._sections = sections
        return sections[0].config

    def _loaded(self, found: dict[str, Any]) -> Section:
        config = msgspec.convert(found["config"], ScheduleConfig)
        if config.l_f < 1:
            raise ValueError("not a timetable: a window has no units")
        section = self._section(int(found["start"]), int(found["m"]), config)
        chosen = {int(m): int(update) for m, update in found["chosen"]}
        if not all(m >= 0 and 1 <= update <= config.l_f for m, update in chosen.items()):
            raise ValueError("not a timetable: a choice is out of its window")
        _chosen(section.schedule).update(chosen)
        return section

    def _section(self, start: int, m: int, config: ScheduleConfig) -> Section:
        if config.kind in ("auto", "auto_bound"):
            chosen = ChosenSchedule(config.l_f, lambda t: self._choose(config, start + t))
            return Section(start, m, config, chosen)
        schedule = best(config) if config.kind == "optimal" else make_schedule(config)
        return Section(start, m, config, schedule)


def best(config: ScheduleConfig) -> FixedSchedule:
    """Windows of l_f units with the bound's N*, but at least one unit of update (paper, section 5).

    Raises:
        ConfigError: the constants do not belong together.
    """
    try:
        split = best_split(HoldProblem(window=config.l_f, **asdict(config.bound)))
    except ConfigError as error:
        name = f"learner.schedule.bound.{error.name}"
        raise ConfigError(name, error.value, error.allowed) from error
    return FixedSchedule(config.l_f, max(split.update, 1) / config.l_f)


def require_constants(config: ScheduleConfig) -> None:
    """Whether the bound's constants belong together, if the schedule is the bound's.

    Raises:
        ConfigError: they do not.
    """
    if config.kind == "optimal":
        best(config)


def cut(window: Window, end: int) -> Window:
    """The window, ended at unit `end` at the latest, which is after its start."""
    if window.end is not None and window.end <= end:
        return window
    update = min(window.update, end - window.start)
    return replace(window, update=update, hold=end - window.start - update)


def _chosen(schedule: Schedule) -> dict[int, int]:
    return schedule.chosen if isinstance(schedule, ChosenSchedule) else {}
