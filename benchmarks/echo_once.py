"""The bare pacer-and-echo pair, once, as a line of JSON: so that it can be run as another user.

python -m benchmarks.echo_once --transport zenoh --hz 500 --seconds 10
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass

import numpy as np
import tyro

from benchmarks.harness import LATE_SHARE
from benchmarks.outcome import Outcome
from launcher.echo.links import Transport
from launcher.echo.measure import EchoResult, measure_echo
from rtcore.realtime import Rt


@dataclass(frozen=True)
class Arguments:
    """As `launcher.echo.measure.measure_echo` takes them."""

    transport: Transport = "zenoh"
    hz: float = 500.0
    seconds: float = 10.0
    rt: Rt = "auto"


def outcome(echo: EchoResult) -> Outcome:
    """The pair's run as the others' are told."""
    late = echo.pacing_ns > LATE_SHARE * 1e9 / echo.hz
    return Outcome(
        ticks=echo.ticks,
        missed=echo.missed + echo.skipped,
        overruns=echo.overruns,
        loop_us=echo.latency_us(),
        pacing_us=echo.pacing_us(),
        stolen_s=echo.steal_s,
        more={"late_share": float(np.mean(late)), "placement": echo.placement},
    )


def main(arguments: Arguments) -> None:
    """Measure and print."""
    echo = measure_echo(arguments.transport, hz=arguments.hz, seconds=arguments.seconds, rt=arguments.rt)
    sys.stdout.write(json.dumps(outcome(echo).as_dict()) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
