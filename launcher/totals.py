"""Ledgers added up: over the lives of a process, and over the processes of a role."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from rtcore.histogram import Histogram
from rtcore.messages import Stats, WindowNotice


@dataclass
class Totals:
    """Ledgers, added up: one process's over its incarnations, or those of several processes."""

    counters: Counter[str] = field(default_factory=Counter)
    gauges: dict[str, float] = field(default_factory=dict)  # of the newest incarnation that has them
    histograms: dict[str, Histogram] = field(default_factory=dict)
    returns: list[float] = field(default_factory=list)  # in the order of the episodes
    windows: list[WindowNotice] = field(default_factory=list)

    def quantiles(self, name: str, scale: float) -> dict[str, float | None]:
        """{p50, p99, p999, max} of a histogram in ns, times `scale`; None where nothing was recorded."""
        return self.histograms.get(name, Histogram()).summary(scale)


def add_up(incarnations: Sequence[Stats]) -> Totals:
    """One process's totals."""
    total = Totals()
    for ledger in sorted(incarnations, key=lambda one: one.incarnation):
        total.counters.update(ledger.counters)
        total.gauges.update(ledger.gauges)
        total.windows.extend(ledger.windows)
        total.returns.extend(one.value for one in sorted(ledger.returns, key=lambda one: one.episode))
        for name, data in ledger.histograms.items():
            histogram = Histogram.from_bytes(data)
            if name in total.histograms:
                total.histograms[name].merge(histogram)
            else:  # to merge it into an empty one would cost five times its decoding
                total.histograms[name] = histogram
    return total


def together(processes: Iterable[Totals]) -> Totals:
    """The totals of several processes, in their order; those of a single one are itself."""
    parts = list(processes)
    if len(parts) == 1:
        return parts[0]
    total = Totals()
    for part in parts:
        total.counters.update(part.counters)
        total.gauges.update(part.gauges)
        total.windows.extend(part.windows)
        total.returns.extend(part.returns)
        for name, histogram in part.histograms.items():
            total.histograms.setdefault(name, Histogram()).merge(histogram)
    return total
