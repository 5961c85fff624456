"""Small things that the live screen and the report both draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.table import Table
from rich.text import Text

BARS = "▁▂▃▄▅▆▇█"
LABEL = "grey58"
ACCENT = "cyan"
MISSES_WORTH_A_LOOK = 0.01  # one deadline in a hundred


def sparkline(values: Sequence[float], width: int) -> str:
    """The newest `width` values as bars between their own minimum and maximum."""
    shown = values[-width:]
    if not shown:
        return ""
    low, high = min(shown), max(shown)
    if high == low:
        return BARS[len(BARS) // 2] * len(shown)
    return "".join(BARS[round((value - low) / (high - low) * (len(BARS) - 1))] for value in shown)


def number(value: float | None, digits: int = 0) -> str:
    """A number with thousands separators; a dot in the middle where there is none yet."""
    return "·" if value is None else f"{value:,.{digits}f}"


def share(value: float | None) -> str:
    """A ratio as a percentage that shows small ones."""
    if value is None:
        return "·"
    return f"{100 * value:.{1 if value >= 0.1 else 2 if value >= 0.0001 or value == 0 else 4}f} %"


def microseconds(value: float | None) -> str:
    """A duration given in microseconds, without its unit."""
    return number(value, 1 if value is not None and value < 10 else 0)


def clock(seconds: float) -> str:
    """Minutes and seconds, 2:05; hours when there are any, 1:02:05."""
    whole = max(0, int(seconds))
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"


def pairs(rows: Sequence[tuple[str, Text | str]]) -> Table:
    """Labels in grey, values beside them."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style=LABEL, no_wrap=True)
    table.add_column()
    for label, value in rows:
        table.add_row(label, value)
    return table


def latencies(
    rows: Mapping[str, Mapping[str, float | None]], names: Sequence[str] = ("p50", "p99", "p999", "max")
) -> Table:
    """One row per quantity, in microseconds; a column for each of the `names`."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style=LABEL, no_wrap=True)
    for _ in names:
        table.add_column(justify="right", no_wrap=True)
    table.add_row("µs", *(Text("p99.9" if name == "p999" else name, style=LABEL) for name in names))
    for label, row in rows.items():
        table.add_row(label, *(microseconds(row[name]) for name in names))
    return table


def causes(missed_by_cause: Mapping[str, int], limit: int | None = None) -> Text:
    """What the misses are due to, the most frequent first and at most `limit`, a line for each two."""
    ranked = sorted(((n, cause) for cause, n in missed_by_cause.items() if n), reverse=True)[:limit]
    parts = [f"{n:,} {cause}" for n, cause in ranked]
    lines = [", ".join(parts[i : i + 2]) for i in range(0, len(parts), 2)]
    return Text("\n".join(lines), style=LABEL)


def misses(missed: int, ratio: float | None) -> Text:
    """The misses, in yellow when they are many."""
    style = "yellow" if ratio is not None and ratio >= MISSES_WORTH_A_LOOK else ""
    return Text(f"{missed:,}  ({share(ratio)})", style=style)
