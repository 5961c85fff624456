"""How long from an observation to its action, and how does that compare with what others build on?

    python -m benchmarks.act_path --seconds 20 --rounds 5

By turns, at each rate: the real system (env server and agent, the agent acting with a 256-256 network),
the bare echo over raw Zenoh and over a unix socket, and gRPC and ZeroMQ with the same messages and the
same inference behind the same pacer. All have the same scheduling and cores. A loop is measured from
the observation's sending to the arrival of its action at the sender. Ratios are those of one round, and
the tables have medians over the rounds. Raw echoes carry the bytes but compute nothing; a peer's client
waits for its answer on the thread that asked, which is its fastest way, and its connection is warm.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import tyro

from benchmarks.harness import ACTING, background_child, child_result, run_system, world, write_result
from benchmarks.outcome import Outcome, Quantile, cell, median, ratios, turns
from benchmarks.peers import TRANSPORTS
from launcher.echo.links import Transport as EchoTransport
from rtcore.realtime import Rt

ECHOES: tuple[str, ...] = get_args(EchoTransport)
HIDDEN = (256, 256)
SYSTEM = "tenuto "  # and the world's name
RAW = "raw zenoh"
PACKAGES = ("eclipse-zenoh", "grpcio", "pyzmq", "numpy")
LIMIT = 1.5  # of the raw Zenoh echo, at p50 and p99


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    hz: tuple[float, ...] = (100.0, 200.0, 500.0, 1000.0)
    seconds: float = 20.0  # per contender, rate and round
    rounds: int = 5
    worlds: tuple[str, ...] = ("pointmass", "halfcheetah")  # presets; the first is compared with the others
    rt: Rt = "auto"
    out: Path = Path("benchmarks/results")


def contenders(arguments: Arguments) -> list[str]:
    """All of them, the compared one first."""
    systems = [SYSTEM + name for name in arguments.worlds]
    return [*systems, *(f"raw {name}" for name in ECHOES), *TRANSPORTS]


def measure(contender: str, hz: float, arguments: Arguments) -> Outcome:
    """One run of one contender."""
    seconds, rt = arguments.seconds, arguments.rt
    if contender.startswith(SYSTEM):
        config = world(contender.removeprefix(SYSTEM), hz=hz, seconds=seconds, rt=rt)
        return run_system(config, ACTING, hidden=HIDDEN)
    timing = [f"--hz={hz}", f"--seconds={seconds}", f"--rt={rt}"]
    if contender in TRANSPORTS:
        return measure_peer(contender, timing, seconds)
    options = ["--transport", contender.removeprefix("raw "), *timing]
    return Outcome.read(child_result("benchmarks.echo_once", options, seconds=seconds))


def measure_peer(transport: str, timing: Sequence[str], seconds: float) -> Outcome:
    """One run of a peer's two processes."""
    with tempfile.TemporaryDirectory(prefix="tenuto-", dir="/tmp") as directory:
        socket = Path(directory) / "s"
        options = ["--transport", transport, "--socket", str(socket), "--parent", str(os.getpid()), *timing]
        with background_child("benchmarks.peer_loop", ["server", *options]):
            return Outcome.read(child_result("benchmarks.peer_loop", ["client", *options], seconds=seconds))


def summarise(found: Mapping[str, Sequence[Outcome]]) -> list[dict[str, Any]]:
    """One row per contender, at one rate; the first contender is the one that is compared."""
    ours = next(iter(found.values()))
    rows = []
    for name, outcomes in found.items():
        row: dict[str, Any] = {"name": name}
        quantiles: tuple[Quantile, ...] = ("p50", "p99", "p999")
        for quantile in quantiles:
            row[quantile] = median([one.loop_us[quantile] for one in outcomes])
            row[f"tenuto_{quantile}_ratio"] = median(ratios(ours, outcomes, quantile))
        row["missed"] = sum(one.missed for one in outcomes)
        row["ticks"] = sum(one.ticks for one in outcomes)
        row["pacing_p999"] = median([one.pacing_us["p999"] for one in outcomes])
        row["stolen_s"] = sum(one.stolen_s or 0.0 for one in outcomes)
        rows.append(row)
    return rows


def verdict(rows: Sequence[Mapping[str, Any]]) -> dict[str, bool | None]:
    """Whether the loop is within 1.5 times the raw echo, and below each peer, at p50 and p99."""
    found: dict[str, bool | None] = {}
    for row in rows:
        limit = LIMIT if row["name"] == RAW else 1.0 if row["name"] in TRANSPORTS else None
        if limit is not None:
            for quantile in ("p50", "p99"):
                ratio = row[f"tenuto_{quantile}_ratio"]
                found[f"{row['name']} {quantile}"] = None if ratio is None else ratio <= limit
    return found


def table(hz: float, rows: Sequence[Mapping[str, Any]]) -> str:
    """One line per contender."""
    head = f"{hz:g} Hz"
    lines = [
        f"{head:20}{'loop p50':>9}{'p99':>8}{'p99.9':>8} us{'tenuto / it: p50':>18}{'p99':>7}"
        f"{'missed':>9}{'pacing p99.9':>14}"
    ]
    lines += [
        f"{row['name']:20}{cell(row['p50'], 9)}{cell(row['p99'], 8)}{cell(row['p999'], 8)}   "
        f"{cell(row['tenuto_p50_ratio'], 18, 2)}{cell(row['tenuto_p99_ratio'], 7, 2)}"
        f"{row['missed'] / max(1, row['ticks']):9.5f}{cell(row['pacing_p999'], 11)} us"
        for row in rows
    ]
    return "\n".join(lines)


def main(arguments: Arguments) -> None:
    """Measure, print a table per rate, write the result."""
    names = contenders(arguments)
    rates: list[dict[str, Any]] = []
    for hz in arguments.hz:
        found: dict[str, list[Outcome]] = {name: [] for name in names}
        for _, name in turns(names, arguments.rounds):
            found[name].append(measure(name, hz, arguments))
        rows = summarise(found)
        print(f"\n{table(hz, rows)}", flush=True)
        runs = {name: [one.as_dict() for one in outcomes] for name, outcomes in found.items()}
        rates.append({"hz": hz, "rows": rows, "verdict": verdict(rows), "runs": runs})
        write_result("act_path", arguments, PACKAGES, {"rates": rates})
    failing = [
        f"{rate['hz']:g} Hz: {name}" for rate in rates for name, ok in rate["verdict"].items() if not ok
    ]
    print(f"\nbeyond its limit: {'; '.join(failing) or 'nothing'}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
