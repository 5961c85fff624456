"""How fast does rtgym's own real-time loop tick, how punctually, and how does ours at the same rates?

    python -m benchmarks.rtgym_loop --seconds 10 --rounds 3

rtgym runs the device and the user's policy in one process, without any transport: its two loops (a
thread per step, and one thread for all) around a world that costs nothing, as it comes and with our
scheduling. Ours is the real system: point mass, an agent in a process of its own, the same network. A
tick's pacing error is how late the world came under its next action; late is beyond a tenth of the
period. rtgym's grid is private, so one is laid through its most punctual ticks, which flatters it. rtgym
counts no misses: its `missed` are the time steps after which it gave its clock up and set it anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.harness import ACTING, child_result, run_system, world, write_result
from benchmarks.outcome import Outcome, cell, median, turns

SYSTEM = "tenuto"
HIDDEN = (256, 256)
# Name -> variant, and whether it gets the scheduling that our env server asks for.
PEERS = {
    "rtgym v1, as it comes": ("v1", "off"),
    "rtgym ts-v1, as it comes": ("ts-v1", "off"),
    "rtgym v1, our scheduling": ("v1", "auto"),
    "rtgym ts-v1, our scheduling": ("ts-v1", "auto"),
}
PACKAGES = ("rtgym", "gymnasium", "eclipse-zenoh", "numpy")
HELD = 0.99  # of the rate asked for
PUNCTUAL = 0.01  # of the ticks may begin later than a tenth of the period


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    hz: tuple[float, ...] = (100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0)
    seconds: float = 10.0  # per contender, rate and round
    rounds: int = 3
    out: Path = Path("benchmarks/results")


def measure(contender: str, hz: float, arguments: Arguments) -> Outcome:
    """One run of one contender."""
    if contender == SYSTEM:
        config = world("pointmass", hz=hz, seconds=arguments.seconds, rt="auto")
        return run_system(config, ACTING, hidden=HIDDEN)
    variant, rt = PEERS[contender]
    options = ["--variant", variant, f"--hz={hz}", f"--seconds={arguments.seconds}", "--rt", rt]
    return Outcome.read(child_result("benchmarks.rtgym_world", options, seconds=arguments.seconds))


def summarise(found: Mapping[str, Sequence[Outcome]]) -> list[dict[str, Any]]:
    """One row per contender, at one rate."""
    rows = []
    for name, outcomes in found.items():
        rows.append({
            "name": name,
            "rate_hz": median([one.more["rate_hz"] for one in outcomes]),
            "late_share": median([one.more["late_share"] for one in outcomes]),
            "missed": sum(one.missed for one in outcomes),
            "ticks": sum(one.ticks for one in outcomes),
            "stolen_s": sum(one.stolen_s or 0.0 for one in outcomes),
        })  # fmt: skip
        rows[-1] |= {q: median([one.pacing_us[q] for one in outcomes]) for q in ("p50", "p99", "p999")}
    return rows


def fastest(rates: Sequence[Mapping[str, Any]], most_late: float = 1.0) -> dict[str, float | None]:
    """Per contender, the highest rate asked for that it held to 99 %, with a share of late ticks of at most
    `most_late`; None: not even the lowest.
    """
    found: dict[str, float | None] = {}
    for rate in sorted(rates, key=lambda rate: float(rate["hz"])):
        for row in rate["rows"]:
            held = row["rate_hz"] >= HELD * rate["hz"] and row["late_share"] <= most_late
            found[row["name"]] = rate["hz"] if held else found.get(row["name"])
    return found


def table(hz: float, rows: Sequence[Mapping[str, Any]]) -> str:
    """One line per contender."""
    lines = [
        f"{f'{hz:g} Hz':29}{'held':>8}{'late':>9}{'pacing p50':>12}{'p99':>7}{'p99.9':>8} us{'missed':>10}"
    ]
    lines += [
        f"{row['name']:29}{cell(row['rate_hz'], 8, 1)}{row['late_share']:9.2%}{cell(row['p50'], 12, 1)}"
        f"{cell(row['p99'], 7)}{cell(row['p999'], 8)}   {row['missed'] / max(1, row['ticks']):10.5f}"
        for row in rows
    ]
    return "\n".join(lines)


def main(arguments: Arguments) -> None:
    """Measure, print a table per rate, write the result."""
    names = [SYSTEM, *PEERS]
    rates: list[dict[str, Any]] = []
    for hz in arguments.hz:
        found: dict[str, list[Outcome]] = {name: [] for name in names}
        for _, name in turns(names, arguments.rounds):
            found[name].append(measure(name, hz, arguments))
        rows = summarise(found)
        print(f"\n{table(hz, rows)}", flush=True)
        runs = {name: [one.as_dict() for one in outcomes] for name, outcomes in found.items()}
        rates.append({"hz": hz, "rows": rows, "runs": runs})
        held = {"fastest_held_hz": fastest(rates), "fastest_punctual_hz": fastest(rates, PUNCTUAL)}
        write_result("rtgym_loop", arguments, PACKAGES, {**held, "rates": rates})
    print(f"\n{'highest rate':29}{f'held to {HELD:.0%}':>14}{f'and at most {PUNCTUAL:.0%} late':>22}")
    punctual = fastest(rates, PUNCTUAL)
    for name, rate in fastest(rates).items():
        print(f"{name:29}{cell(rate, 11)} Hz{cell(punctual[name], 19)} Hz")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
