"""Does recording, with the live stream watched, cost the loop anything?

    python -m benchmarks.recorder_cost --seconds 20 --rounds 5

By turns: the env server, the agent and a learner at its preset's settings, without a recorder; and the
same with a recorder that writes the file in full detail and streams to a viewer. The viewer has no window:
it is Rerun's own client saving what it is sent, at the niceness that `tenuto run` gives to viewers, so it
receives as a browser's does but draws nothing. Besides, what a row costs the recorder: its processor time
once it serves viewers, over the rows that it wrote.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from benchmarks.arms import WITH, compare, table
from benchmarks.harness import LEARNING, BenchmarkError, run_system, world, write_result
from benchmarks.outcome import Outcome
from launcher.run import NICENESS
from recorder.finish import switch_off_statistics
from recorder.sinks import HOST, live_url
from rtcore import channels
from rtcore.realtime import Rt

PACKAGES = ("eclipse-zenoh", "rerun-sdk", "torch", "numpy")


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    world: str = "halfcheetah"
    hz: tuple[float, ...] = (200.0, 500.0)
    seconds: float = 20.0  # of each run
    rounds: int = 5
    rt: Rt = "auto"
    out: Path = Path("benchmarks/results")


class SavingViewer:
    """A viewer without a window. It starts when the stream is there: call `poll` until then."""

    def __init__(self, port: int, into: Path) -> None:
        self._port = port
        self._into = into
        self._process: subprocess.Popen[bytes] | None = None

    def poll(self) -> bool:
        """Connect, once, as soon as somebody listens; says whether it has."""
        if self._process is not None:
            return True
        with socket.socket() as probe:
            if probe.connect_ex((HOST, self._port)):
                return False
        home = self._into.with_suffix(".home")
        switch_off_statistics(home)
        self._process = subprocess.Popen(
            ["nice", "-n", str(NICENESS), sys.executable, "-m", "rerun", "--save", str(self._into),
             live_url(self._port)],
            env={"HOME": str(home)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            process_group=0,
        )  # fmt: skip
        return True

    def close(self) -> None:
        """End it, and the program that Python started for it."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    @property
    def received_bytes(self) -> int:
        """What it was sent, as saved."""
        return self._into.stat().st_size if self._into.exists() else 0


class ProcessorTime:
    """Of this process's child that runs a module, as last seen: call `poll` until it ends."""

    def __init__(self, module: str) -> None:
        self._module = module.encode()
        self._stat: Path | None = None
        self.seconds = 0.0
        self.begun_at: float | None = None

    def begin(self) -> None:
        """Count from here, once."""
        if self.begun_at is None:
            self.begun_at = self.seconds

    def poll(self) -> None:
        """Find the child if need be, and read its account."""
        with contextlib.suppress(OSError):  # it has ended
            if self._stat is None:
                self._stat = next(self._found(), None)
            if self._stat is not None:
                fields = self._stat.read_text().rpartition(")")[2].split()
                self.seconds = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def _found(self) -> Iterator[Path]:
        for task in Path("/proc/self/task").iterdir():
            for child in (task / "children").read_text().split():
                if self._module in Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0"):
                    yield Path(f"/proc/{child}/stat")


def measure(arm: str, hz: float, arguments: Arguments) -> Outcome:
    """One run of one arm."""
    config = world(arguments.world, hz=hz, seconds=arguments.seconds, rt=arguments.rt)
    if arm != WITH:
        return run_system(config, LEARNING)
    port = free_port()
    recorder = replace(config.recorder, record=True, detail="full", view="web", port=port)
    with tempfile.TemporaryDirectory() as directory:
        viewer, spent = SavingViewer(port, Path(directory) / "seen.rrd"), ProcessorTime(channels.RECORDER)

        def poll() -> None:
            spent.poll()
            if viewer.poll():
                spent.begin()

        with closing(viewer):
            found = run_system(
                replace(config, recorder=recorder), (*LEARNING, channels.RECORDER), on_poll=poll
            )
            if not viewer.received_bytes:
                raise BenchmarkError("the viewer received nothing")
            more: dict[str, Any] = {**found.more, "viewer_bytes": viewer.received_bytes}
    spent_s = spent.seconds - (spent.begun_at or 0.0)
    more["recorder_cpu_us_per_row"] = spent_s * 1e6 / max(1, more["recorder"]["rows"])
    return replace(found, more=more)


def free_port() -> int:
    """A port that nobody has at this moment."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def main(arguments: Arguments) -> None:
    """Measure, print a table per rate, write the result."""
    rates = []
    for hz in arguments.hz:
        found = compare(lambda arm, hz=hz: measure(arm, hz, arguments), arguments.rounds)  # type: ignore[misc]
        print("\n" + table(f"recorder and stream, {hz:g} Hz", found), flush=True)
        per_row = sorted(run["more"]["recorder_cpu_us_per_row"] for run in found["runs"][WITH])
        print(f"processor time per row: {' '.join(f'{one:.1f}' for one in per_row)} us", flush=True)
        rates.append({"hz": hz, **found})
        write_result("recorder_cost", arguments, PACKAGES, {"rates": rates})


if __name__ == "__main__":
    main(tyro.cli(Arguments))
