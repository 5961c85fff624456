"""`python -m launcher.echo.pair client|server|load DIR`: the processes behind `launcher.echo.measure`.

The pair has the places of env server and agent, and nothing of either: no environment, no policy, no bus.
The third one stands in for a learner that takes all that it is given.
"""

from __future__ import annotations

import sys
from array import array
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from launcher.echo.links import LINKS, Send, Transport
from launcher.stealing import StealMeter
from rtcore import channels, realtime
from rtcore.clock import Clock
from rtcore.lifecycle import Stop, die_with_parent, stop_on_signals
from rtcore.monotonic import MonotonicClock
from rtcore.pacer import Pacer, Tick
from rtcore.realtime import Rt

# A HalfCheetah step and its action as they travel, checksum included: 17 observed values, 6 acted ones.
STEP_BYTES, ACTION_BYTES = 290, 67
TICK_BYTES = 8  # at the beginning of both: which tick this is, or answers
FILLING = bytes(STEP_BYTES - TICK_BYTES)
HELLO = (1 << 63) - 1  # asked until answered, before tick 0
HELLO_EVERY_S, HELLO_LIMIT_S = 0.02, 10.0
LEAD_NS = 50_000_000
FOR_EVER_S = 3600.0
# SAC with two layers of 256 and a batch of 256: 577 MFLOP and 1.3 MB of parameters, moments and gradients.
LOAD_WIDTH, LOAD_PRODUCTS = 256, 17
LOAD_PARAMETERS, LOAD_PASSES = 80_000, 4


class Order(msgspec.Struct, frozen=True):
    """What the pair is to do, in `order.json`."""

    transport: Transport
    hz: float
    ticks: int
    rt: Rt
    parent: int  # pid: the pair ends with it


class Outcome(msgspec.Struct, frozen=True):
    """What it did, in `outcome.json`; the series are in `series.npz`."""

    placement: str
    missed: int
    overruns: int
    skipped: int
    span_s: float
    steal_s: float | None


@dataclass
class Client:
    """The env server's part of a tick: look for the answer, send, never wait.

    Attributes:
        answers: the newest answer and when it came; filled on the receiving thread.
        missed: ticks that found no answer to what was sent last.
        index, pacing_ns, latency_ns: for each tick its number, how late it began, and how long the newest
            answer took if it was not seen before, else -1. An answer that came late counts, as it does
            in the env server: leaving it out would flatter the way.
    """

    clock: Clock
    answers: deque[tuple[int, bytes]]
    send: Send
    missed: int = 0
    index: array[int] = field(default_factory=lambda: array("q"))
    pacing_ns: array[int] = field(default_factory=lambda: array("q"))
    latency_ns: array[int] = field(default_factory=lambda: array("q"))
    _sent_ns: dict[int, int] = field(default_factory=dict)
    _last: int = -1

    def greet(self, deadline_ns: int) -> bool:
        """Ask until something is answered, at most until `deadline_ns`; say whether it was."""
        while self.clock.now_ns() < deadline_ns:
            self.send(HELLO.to_bytes(TICK_BYTES, "little") + FILLING)
            self.clock.sleep_until_ns(self.clock.now_ns() + round(HELLO_EVERY_S * 1e9))
            if self.answers:
                return True
        return False

    def step(self, tick: Tick) -> None:
        """One deadline."""
        answered, latency_ns = self._take()
        self.missed += self._last >= 0 and answered != self._last
        sent_ns = self.clock.now_ns()
        self.send(tick.index.to_bytes(TICK_BYTES, "little") + FILLING)
        self._sent_ns[tick.index] = sent_ns
        self._last = tick.index
        self.index.append(tick.index)
        self.pacing_ns.append(tick.woke_ns - tick.due_ns)
        self.latency_ns.append(latency_ns)

    def _take(self) -> tuple[int, int]:
        """The tick that the newest answer belongs to, and how long it took; -1 and -1 without one."""
        if not self.answers:
            return -1, -1
        received_ns, payload = self.answers.pop()
        tick = int.from_bytes(payload[:TICK_BYTES], "little")
        sent_ns = self._sent_ns.get(tick)
        if sent_ns is None:  # the greeting
            return -1, -1
        return tick, received_ns - sent_ns


def answer(payload: bytes) -> bytes:
    """An action's worth of bytes, with the tick that it answers."""
    return payload[:ACTION_BYTES]


def serve(directory: Path, order: Order, stop: Stop) -> int:
    """Answer until stopped."""
    realtime.enter(channels.AGENT, order.rt)
    with LINKS[order.transport].server(directory, answer):
        stop.wait(FOR_EVER_S)
    return 0


def burden(directory: Path, order: Order, stop: Stop) -> int:  # noqa: ARG001 - as the other parts
    """Until stopped, compute what an update of SAC costs: products, and a pass over the parameters."""
    realtime.enter(channels.LEARNER, order.rt)
    activations = np.ones((LOAD_WIDTH, LOAD_WIDTH), np.float32)
    weights, product = activations / LOAD_WIDTH, np.empty_like(activations)
    parameters = np.ones((LOAD_PASSES, LOAD_PARAMETERS), np.float32)
    while not stop.is_set():
        for _ in range(LOAD_PRODUCTS):
            np.matmul(activations, weights, out=product)
        for row in parameters:
            np.multiply(row, 0.999, out=row)
    return 0


def ask(directory: Path, order: Order, stop: Stop) -> int:
    """Tick through the order and write what was measured."""
    placement = realtime.enter(channels.ENV_SERVER, order.rt)
    clock = MonotonicClock()
    answers: deque[tuple[int, bytes]] = deque(maxlen=1)
    link = LINKS[order.transport]
    with link.client(directory, lambda payload: answers.append((clock.now_ns(), payload))) as send:
        client = Client(clock, answers, send)
        if not client.greet(clock.now_ns() + round(HELLO_LIMIT_S * 1e9)):
            sys.stderr.write(f"the {order.transport} echo was not answered within {HELLO_LIMIT_S:g} s\n")
            return 1
        t0_ns = clock.now_ns() + LEAD_NS
        pacer = Pacer(clock, t0_ns=t0_ns, period_ns=round(1e9 / order.hz), end_index=order.ticks)
        steal = StealMeter()
        for tick in pacer.ticks(stop):
            client.step(tick)
        span_s = (clock.now_ns() - t0_ns) / 1e9
    np.savez(
        directory / "series.npz",
        index=np.array(client.index, np.int64),
        pacing_ns=np.array(client.pacing_ns, np.int64),
        latency_ns=np.array(client.latency_ns, np.int64),
    )
    outcome = Outcome(
        placement.describe(), client.missed, pacer.overruns, pacer.skipped_total, span_s, steal.elapsed_s()
    )
    (directory / "outcome.json").write_bytes(msgspec.json.encode(outcome))
    return 0


PARTS = {"client": ask, "server": serve, "load": burden}


def main(argv: Sequence[str]) -> int:
    """Be one of them."""
    part, directory = argv[0], Path(argv[1])
    order = msgspec.json.decode((directory / "order.json").read_bytes(), type=Order)
    die_with_parent(order.parent)
    stop = Stop()
    with stop_on_signals(stop):
        try:
            return PARTS[part](directory, order, stop)
        except realtime.RealtimeError as error:
            sys.stderr.write(f"{error}\n")
            return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
