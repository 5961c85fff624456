"""From stats, phases and policies to rows: what the learner did and what everybody said. Pure.

Messages may come twice (retained ones, and what stats repeat); each counts once, over all lives of the
recorder.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Mapping
from functools import partial

import numpy as np

from recorder.place import Told
from recorder.rows import Index, Lines, Rows, Scalars, States, Timeline
from recorder.seen import EVENTS_KEPT, STATS_KEPT, STATS_MARKED, Seen
from rtcore.cast import index_of, role_of
from rtcore.channels import LEARNER
from rtcore.messages import Level, Policy, Stats, WindowNotice

FORECAST = "/learner/forecast"
OF_ONE: Mapping[int, Timeline] = {}
_STATS = partial(Seen, kept=STATS_KEPT, marked=STATS_MARKED)
_EVENTS = partial(Seen, kept=EVENTS_KEPT)


class TelemetryRows:
    """Collects messages, and gives their rows when asked: by then the steps before them are known."""

    def __init__(self) -> None:
        self._lines: list[tuple[int, Level, str, int | None]] = []  # the last: of which environment
        self._gauges: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)
        self._forecasts: list[tuple[int, dict[str, float]]] = []
        self._phases: list[tuple[int, str]] = []
        self._versions: list[tuple[int, int]] = []
        self._stats_seen: defaultdict[str, Seen] = defaultdict(_STATS)
        self._events_seen: defaultdict[str, Seen] = defaultdict(_EVENTS)
        self._notices_seen = Seen()
        self._policies_seen = Seen()
        self.forecast_names: list[str] = []  # series of `FORECAST`, in the order of the row; grows

    def go_on_from(self, told: Told) -> None:
        """Begin where an earlier life of the recorder ended. Call it before anything is taken."""
        self._stats_seen.update({name: _STATS(mark) for name, mark in told.stats.items()})
        self._events_seen.update({name: _EVENTS(mark) for name, mark in told.events.items()})
        self._notices_seen = Seen(told.notices)
        self._policies_seen = Seen(told.policies)
        self.forecast_names = list(told.forecast_names)

    @property
    def told(self) -> Told:
        """What was taken so far, by this life and earlier ones."""
        return Told(
            {name: seen.mark() for name, seen in self._stats_seen.items()},
            {name: seen.mark() for name, seen in self._events_seen.items()},
            self._notices_seen.mark(),
            self._policies_seen.mark(),
            list(self.forecast_names),
        )

    def stats(self, stats: Stats) -> None:
        """Take a ledger: its events, the learner's gauges, and phases whose notice was lost."""
        if not self._stats_seen[stats.process].add(stats.at_ns, stats.seq):
            return
        seen = self._events_seen[stats.process]
        prefix = f"{stats.process}: "  # some name themselves
        for event in stats.events:
            if seen.add(event.at_ns, zlib.crc32(event.text.encode())):
                text = f"[{stats.process}] {event.text.removeprefix(prefix)}"
                self._lines.append((event.at_ns, event.level, text, index_of(stats.process)))
        for notice in stats.windows:
            self.window(notice)
        if role_of(stats.process) == LEARNER:
            self._take_gauges(stats)

    def window(self, notice: WindowNotice) -> None:
        """Take the start of a phase."""
        number = (notice.window << 2) + 2 * (notice.phase == "hold") + (notice.reason == "operator")
        if not self._notices_seen.add(notice.at_ns, number):
            return
        self._phases.append((notice.at_ns, notice.phase))
        if notice.reason == "operator":
            what = "holds the policy" if notice.phase == "hold" else "resumes the schedule"
            text = f"[operator] {what} in window {notice.window}"
            self._lines.append((notice.at_ns, "INFO", text, None))

    def policy(self, policy: Policy) -> None:
        """Take a published iterate."""
        if self._policies_seen.add(policy.created_ns, policy.version):
            self._versions.append((policy.created_ns, policy.version))

    def rows(self, timeline: Timeline, of_envs: Mapping[int, Timeline] = OF_ONE) -> list[Rows]:
        """Everything taken since the last call.

        Args:
            timeline: of what is no environment's own.
            of_envs: a fleet's, by the environment's index, for what its own processes say; those that have
                not declared themselves yet may be missing.
        """
        tables: list[Rows] = []
        if self._lines:
            tables.append(self._line_rows(timeline, of_envs))
        if self._phases:
            at_ns, names = zip(*self._phases, strict=True)
            tables.append(Rows("/learner/phase", timeline.of_stamps(at_ns), States(names)))
        if self._versions:
            tables.append(_scalar_rows("/learner/published_version", self._versions, timeline))
        tables += [_scalar_rows(entity, points, timeline) for entity, points in self._gauges.items()]
        if self._forecasts:
            tables.append(self._forecast_rows(timeline))
        for pending in (self._lines, self._phases, self._versions, self._gauges, self._forecasts):
            pending.clear()
        return tables

    def _take_gauges(self, stats: Stats) -> None:
        forecasts: dict[str, float] = {}
        for name, value in stats.gauges.items():
            if name.startswith("forecast/"):
                forecasts[name.removeprefix("forecast/")] = value
            else:
                self._gauges[f"/learner/{name}"].append((stats.at_ns, value))
        if forecasts:
            self._forecasts.append((stats.at_ns, forecasts))
            self.forecast_names += sorted(forecasts.keys() - set(self.forecast_names))

    def _line_rows(self, timeline: Timeline, of_envs: Mapping[int, Timeline]) -> Rows:
        at_ns, levels, texts, envs = zip(*self._lines, strict=True)
        owners = [timeline if env is None else of_envs.get(env, timeline) for env in envs]
        if all(owner is timeline for owner in owners):
            return Rows("/log", timeline.of_stamps(at_ns), Lines(texts, levels))
        single = [owner.of_stamps([at]) for owner, at in zip(owners, at_ns, strict=True)]
        return Rows("/log", Index.joined(single), Lines(texts, levels))

    def _forecast_rows(self, timeline: Timeline) -> Rows:
        index = timeline.of_stamps([at_ns for at_ns, _ in self._forecasts])
        nan = float("nan")
        values = [[row.get(name, nan) for name in self.forecast_names] for _, row in self._forecasts]
        return Rows(FORECAST, index, Scalars(np.array(values, np.float64)))


def _scalar_rows(
    entity: str, points: list[tuple[int, float]] | list[tuple[int, int]], timeline: Timeline
) -> Rows:
    index = timeline.of_stamps([at_ns for at_ns, _ in points])
    return Rows(entity, index, Scalars(np.array([[value] for _, value in points], np.float64)))
