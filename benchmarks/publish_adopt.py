"""How long until a published policy acts, and do arriving policies disturb the loop?

    python -m benchmarks.publish_adopt --seconds 20 --rounds 5

First: a real learner publishes a policy at the end of each unit of one second, of three sizes; the latency
is the agent's own, from the policy's creation to the swap. Second: the loop while policies of the largest
size arrive each second, against a learner that trains as much and publishes nothing. The learner trains
a little only, so that the policies' share of the difference is seen. In both arms the agent acts from
the first tick with a network of that size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import tyro

from benchmarks.arms import WITH, compare, table
from benchmarks.harness import LEARNING, run_system, world, write_result
from benchmarks.outcome import Outcome, cell, median
from rtcore.config import RunConfig
from rtcore.realtime import Rt

UPDATES_PER_S = 20.0
BATCH = 32
PACKAGES = ("eclipse-zenoh", "torch", "numpy")


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    widths: tuple[int, ...] = (128, 256, 490)  # of both hidden layers: 0.08, 0.29 and 1.0 MB for HalfCheetah
    world: str = "halfcheetah"
    hz: float = 500.0
    seconds: float = 20.0  # of each run
    rounds: int = 5
    rt: Rt = "auto"
    out: Path = Path("benchmarks/results")


def configure(arguments: Arguments, width: int, *, publishes: bool) -> RunConfig:
    """A run whose learner trains a little, and publishes each second or never."""
    base = world(arguments.world, hz=arguments.hz, seconds=arguments.seconds, rt=arguments.rt)
    learner = replace(
        base.learner,
        hidden=(width, width),
        batch=BATCH,
        learning_starts=BATCH,
        utd=UPDATES_PER_S / arguments.hz,
        schedule=replace(base.learner.schedule, kind="fixed", l_f=10, gamma_f=1.0),  # no hold
    )
    # A policy is published at the end of a unit: none ends within a run when it is longer than that.
    return replace(base, learner=learner, env=replace(base.env, unit_s=1.0 if publishes else 1e4))


def policy_bytes(observation_dim: int, action_dim: int, hidden: Sequence[int]) -> int:
    """The weights' share of a policy's message: float32 layers with biases, two heads."""
    widths = [observation_dim, *hidden, 2 * action_dim]
    return 4 * sum((width + 1) * out for width, out in pairwise(widths))


def latencies(arguments: Arguments) -> list[dict[str, Any]]:
    """Publish to adopt, one row per size, the sizes by turns."""
    found: dict[int, list[Outcome]] = {width: [] for width in arguments.widths}
    for _ in range(arguments.rounds):
        for width in arguments.widths:
            found[width].append(run_system(configure(arguments, width, publishes=True), LEARNING))
    rows = []
    for width, outcomes in found.items():
        policies = [one.more["policies"] for one in outcomes]
        latency = [one["publish_to_adopt_ms"] for one in policies]
        rows.append({
            "hidden": [width, width],
            "bytes": policy_bytes(*dimensions(arguments.world), (width, width)),
            "adopted": sum(one["adopted"] for one in policies),
            "published": sum(one["published"] for one in policies),
            "p50_ms": median([one["p50"] for one in latency]),
            "max_ms": max((one["max"] for one in latency if one["max"] is not None), default=math.nan),
            "runs": policies,
        })  # fmt: skip
    return rows


def dimensions(name: str) -> tuple[int, int]:
    """Of a preset's observation and action."""
    from env_server.worlds.registry import make_world

    config = world(name, hz=100.0, seconds=1.0, rt="off")
    made = make_world(config.env, 0)
    try:
        return made.observation_dim, made.action_dim
    finally:
        made.close()


def main(arguments: Arguments) -> None:
    """Measure, print both tables, write the result."""
    rows = latencies(arguments)
    print(f"{'policy':>12}{'bytes':>10}{'adopted':>9}{'publish to adopt: p50':>23}{'max':>9} ms")
    for row in rows:
        hidden = "-".join(map(str, row["hidden"]))
        print(
            f"{hidden:>12}{row['bytes']:10}{row['adopted']:9}{cell(row['p50_ms'], 23, 2)}{row['max_ms']:9.2f}"
        )
    width = max(arguments.widths)

    def measure(arm: str) -> Outcome:
        config = configure(arguments, width, publishes=arm == WITH)
        return run_system(config, LEARNING, hidden=(width, width))

    loop = compare(measure, arguments.rounds)
    print("\n" + table(f"{rows[-1]['bytes'] / 1e6:.2f} MB each second", loop))
    write_result("publish_adopt", arguments, PACKAGES, {"latencies": rows, "loop": loop})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
