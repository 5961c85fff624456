"""Does something cost the loop anything? Runs with it and without it, by turns, and their ratio. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from benchmarks.outcome import Outcome, Quantile, cell, median, ratios, turns

WITHOUT, WITH = "without", "with"
QUANTILES: tuple[Quantile, ...] = ("p50", "p99", "p999")
COLUMNS: tuple[tuple[Quantile, int], ...] = (("p50", 9), ("p99", 8), ("p999", 8))
LIMIT = 1.05  # of the loop's p99 without


def compare(measure: Callable[[str], Outcome], rounds: int) -> dict[str, Any]:
    """Measure both arms by turns.

    Args:
        measure: one run; given `WITHOUT` or `WITH`.
        rounds: of one run each; every second round begins with the other arm.

    Returns:
        Medians, their ratios, the ratios of each round, whether the p99's is within its limit, the runs.
    """
    found: dict[str, list[Outcome]] = {WITHOUT: [], WITH: []}
    for _, arm in turns((WITHOUT, WITH), rounds):
        found[arm].append(measure(arm))
    by_round = {quantile: ratios(found[WITH], found[WITHOUT], quantile) for quantile in QUANTILES}
    p99 = median(by_round["p99"])
    return {
        "rows": [_row(arm, outcomes) for arm, outcomes in found.items()],
        "ratio": {quantile: median(values) for quantile, values in by_round.items()},
        "ratio_by_round": by_round,
        "within_limit": None if p99 is None else p99 <= LIMIT,
        "runs": {arm: [one.as_dict() for one in outcomes] for arm, outcomes in found.items()},
    }


def table(title: str, found: dict[str, Any]) -> str:
    """Both arms, and the ratio with its spread over the rounds."""
    lines = [f"{title:24}{'loop p50':>9}{'p99':>8}{'p99.9':>8} us{'missed':>9}{'pacing p99.9':>14}"]
    lines += [
        f"{row['name']:24}{''.join(cell(row[quantile], width) for quantile, width in COLUMNS)}   "
        f"{row['missed'] / max(1, row['ticks']):9.5f}{cell(row['pacing_p999'], 11)} us"
        for row in found["rows"]
    ]
    lines.append(
        f"{'with / without':24}{''.join(cell(found['ratio'][name], width, 3) for name, width in COLUMNS)}"
    )
    lines.append(f"p99 by round: {_spread(found['ratio_by_round']['p99'])}; limit {LIMIT}")
    return "\n".join(lines)


def _row(arm: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    return {
        "name": arm,
        **{quantile: median([one.loop_us[quantile] for one in outcomes]) for quantile in QUANTILES},
        "pacing_p999": median([one.pacing_us["p999"] for one in outcomes]),
        "missed": sum(one.missed for one in outcomes),
        "ticks": sum(one.ticks for one in outcomes),
        "stolen_s": sum(one.stolen_s or 0.0 for one in outcomes),
    }


def _spread(values: Sequence[float]) -> str:
    return " ".join(f"{value:.3f}" for value in sorted(values))
