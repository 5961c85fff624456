"""What one contender's run came to, and how runs of several contenders become a table. Pure."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from rtcore.histogram import Histogram

Quantile = Literal["p50", "p99", "p999", "max"]
Quantiles = Mapping[str, float | None]

_RANKS = 40  # halvings: enough for any count that a histogram holds


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One run of one contender at one rate.

    Attributes:
        ticks: deadlines that were kept, early or late.
        missed: ticks at which the answer to the observation before was not there, lost deadlines included.
        overruns: times that one or more deadlines were lost.
        loop_us: observation sent -> its answer received by the sender: p50, p99, p999 and max.
        pacing_us: by how much the ticks began late; likewise.
        stolen_s: CPU seconds that the host gave to others meanwhile, over all cores; None: untold.
        more: what only this contender tells.
    """

    ticks: int
    missed: int
    overruns: int
    loop_us: Quantiles
    pacing_us: Quantiles
    stolen_s: float | None = None
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def miss_ratio(self) -> float:
        """Misses per tick; 1 when there was none."""
        return self.missed / self.ticks if self.ticks else 1.0

    @classmethod
    def read(cls, found: Mapping[str, Any]) -> Outcome:
        """What `as_dict` made."""
        return cls(**{name: value for name, value in found.items() if name != "miss_ratio"})

    def as_dict(self) -> dict[str, Any]:
        """For the result's file."""
        return asdict(self) | {"miss_ratio": self.miss_ratio}


def turns(contenders: Sequence[str], rounds: int) -> Iterator[tuple[int, str]]:
    """(round, contender), by turns; each round begins one further on, so that nobody is always first."""
    for number in range(rounds):
        first = number % len(contenders)
        for name in (*contenders[first:], *contenders[:first]):
            yield number, name


def median(values: Sequence[float | None]) -> float | None:
    """The median of what was measured; None if nothing was."""
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def ratios(ours: Sequence[Outcome], theirs: Sequence[Outcome], quantile: Quantile) -> list[float]:
    """Our loop over theirs, one a round: both were measured in the same minute."""
    pairs = [(a.loop_us.get(quantile), b.loop_us.get(quantile)) for a, b in zip(ours, theirs, strict=True)]
    return [a / b for a, b in pairs if a is not None and b]


def share_above(histogram: Histogram, threshold: float) -> float:
    """The share of a histogram's values beyond `threshold`, as exact as its bins; 0 when it is empty."""
    if histogram.count == 0:
        return 0.0
    low, high = 0.0, 1.0  # the share of values at or below the threshold is in here
    first = histogram.quantile(0.0)
    assert first is not None
    if first > threshold:
        return 1.0
    for _ in range(_RANKS):
        middle = (low + high) / 2
        value = histogram.quantile(middle)
        assert value is not None
        low, high = (middle, high) if value <= threshold else (low, middle)
    return 1.0 - round(high * histogram.count) / histogram.count


def cell(value: float | None, width: int, digits: int = 0) -> str:
    """A number in a column; a dash where there is none."""
    return f"{'-':>{width}}" if value is None else f"{value:{width}.{digits}f}"
