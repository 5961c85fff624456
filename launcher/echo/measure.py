"""The bare pacer-and-echo pair: what this machine and the transport cost without anything of ours.

Two processes with the places of env server and agent. One ticks and sends a step's worth of bytes, the
other sends an action's worth back; at the next deadline the first looks whether it is there. What the
real system takes beyond that is the environment, the policy, the messages and the bus.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from launcher.echo.links import LINKS, Transport
from launcher.echo.pair import HELLO_LIMIT_S, Order, Outcome
from launcher.quantiles import Nanoseconds, Quantiles, quantiles_us
from rtcore.config import ConfigError
from rtcore.realtime import Rt
from rtcore.socket_dir import TEMP

POLL_S = 0.1
END_LIMIT_S = 5.0
START_LIMIT_S = 10.0  # for a process to start on a busy machine, beside HELLO_LIMIT_S for the first answer


class EchoError(RuntimeError):
    """The pair could not be started, or ended badly."""


@dataclass(frozen=True, slots=True)
class EchoResult:
    """One run of the pair. The arrays have one element per tick that was executed.

    Attributes:
        transport, hz, rt: as asked for.
        placement: what the client obtained, in words.
        index: numbers of the ticks; a deadline that was lost has none.
        pacing_ns: how late each tick began.
        latency_ns: how long the newest answer took, if it was not seen before this tick; else -1.
        missed: ticks that found no answer to what was sent last.
        overruns: times that one or more deadlines were lost.
        skipped: deadlines lost.
        span_s: from the first deadline to the end.
        steal_s: what the host took in that span, over all processors; None where it is not told.
    """

    transport: Transport
    hz: float
    rt: Rt
    placement: str
    index: Nanoseconds
    pacing_ns: Nanoseconds
    latency_ns: Nanoseconds
    missed: int
    overruns: int
    skipped: int
    span_s: float
    steal_s: float | None

    @property
    def ticks(self) -> int:
        """Ticks executed."""
        return len(self.index)

    @property
    def miss_ratio(self) -> float:
        """Misses per executed tick."""
        return self.missed / max(1, self.ticks)

    def latency_us(self, after_s: float = 0.0) -> Quantiles:
        """{p50, p99, p999, max} of the round trips seen `after_s` seconds from tick 0 or later."""
        return quantiles_us(self.latency_ns[self._from(after_s) & (self.latency_ns >= 0)])

    def pacing_us(self, after_s: float = 0.0) -> Quantiles:
        """{p50, p99, p999, max} of the pacing errors, `after_s` seconds from tick 0 or later."""
        return quantiles_us(self.pacing_ns[self._from(after_s)])

    def _from(self, after_s: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return self.index >= after_s * self.hz


def measure_echo(
    transport: Transport,
    *,
    hz: float,
    seconds: float,
    rt: Rt = "auto",
    load: bool = False,
    on_poll: Callable[[], None] = lambda: None,
) -> EchoResult:
    """Run the pair.

    Args:
        transport: "zenoh": raw Zenoh with the settings of the bus's real-time path; "unix": a unix socket.
        hz: ticks per second.
        seconds: for so long; the processes' start takes about one more.
        rt: as `agent.rt`; see `rtcore.realtime.enter`.
        load: beside a process with the learner's place that computes without end.
        on_poll: called ten times a second meanwhile.

    Raises:
        ConfigError: an argument is wrong.
        EchoError: the pair could not be started, or ended badly, as when `rt` is "require" and refused.
    """
    if transport not in LINKS:
        raise ConfigError("transport", transport, "must be one of " + ", ".join(LINKS))
    for name, value in (("hz", hz), ("seconds", seconds)):
        if not 0 < value < float("inf"):
            raise ConfigError(name, value, "must be a positive number")
    # Below /tmp whatever $TMPDIR says: a unix socket's path is short.
    with tempfile.TemporaryDirectory(prefix="tenuto-echo-", dir=TEMP) as name:
        directory = Path(name)
        order = Order(transport, hz, max(2, round(seconds * hz)), rt, os.getpid())
        (directory / "order.json").write_bytes(msgspec.json.encode(order))
        with ExitStack() as processes:
            for part in ("load", "server") if load else ("server",):
                processes.enter_context(_process(part, directory))
            client = processes.enter_context(_process("client", directory))
            _wait(client, directory, START_LIMIT_S + HELLO_LIMIT_S + 2 * seconds, on_poll)
        return _read(order, directory)


@contextmanager
def _process(part: str, directory: Path) -> Iterator[subprocess.Popen[bytes]]:
    """One of the processes; ended when the block is left. Its own process group keeps Ctrl-C from it."""
    threads = ["env", "OPENBLAS_NUM_THREADS=1"] if part == "load" else []  # as the learner: one of them
    with (directory / f"{part}.out").open("wb") as output:
        process = subprocess.Popen(
            [*threads, sys.executable, "-m", "launcher.echo.pair", part, str(directory)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            process_group=0,
        )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait(
    client: subprocess.Popen[bytes], directory: Path, limit_s: float, on_poll: Callable[[], None]
) -> None:
    deadline = time.monotonic() + limit_s
    while (code := client.poll()) is None:
        if time.monotonic() >= deadline:
            raise EchoError(f"the echo did not end within {limit_s:.0f} s{_said(directory)}")
        on_poll()
        time.sleep(POLL_S)
    if code:
        raise EchoError(f"the echo failed (exit code {code}){_said(directory)}")


def _said(directory: Path) -> str:
    """The last line of each process, for an error."""
    texts = [(directory / f"{part}.out").read_text(errors="replace") for part in ("client", "server")]
    lines = [text.strip().splitlines()[-1] for text in texts if text.strip()]
    return ": " + "; ".join(lines) if lines else ""


def _read(order: Order, directory: Path) -> EchoResult:
    outcome = msgspec.json.decode((directory / "outcome.json").read_bytes(), type=Outcome)
    with np.load(directory / "series.npz") as series:
        return EchoResult(
            order.transport,
            order.hz,
            order.rt,
            outcome.placement,
            series["index"],
            series["pacing_ns"],
            series["latency_ns"],
            outcome.missed,
            outcome.overruns,
            outcome.skipped,
            outcome.span_s,
            outcome.steal_s,
        )
