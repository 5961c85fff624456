"""The bare pacer-and-echo pair: its accounting exactly, and both transports between real processes."""

from __future__ import annotations

import os
import sys
from collections import deque
from pathlib import Path

import numpy as np
import pytest

from launcher.echo.measure import EchoError, EchoResult, measure_echo
from launcher.echo.pair import ACTION_BYTES, STEP_BYTES, TICK_BYTES, Client, answer
from rtcore.clock import VirtualClock
from rtcore.config import ConfigError
from rtcore.pacer import Tick


class Wire:
    """What a client sends, and a way to answer it."""

    def __init__(self) -> None:
        self.clock = VirtualClock(1000)
        self.sent: list[bytes] = []
        self.answers: deque[tuple[int, bytes]] = deque(maxlen=1)
        self.client = Client(self.clock, self.answers, self.sent.append)

    def tick(self, index: int, *, woke_late_ns: int = 0) -> None:
        due_ns = 1000 + 100 * index
        self.clock.sleep_until_ns(due_ns + woke_late_ns)
        self.client.step(Tick(index, due_ns, self.clock.now_ns(), 0))

    def answer(self, number: int, *, after_ns: int) -> None:
        """Answer the `number`-th message, `after_ns` from now."""
        self.answers.append((self.clock.now_ns() + after_ns, answer(self.sent[number])))


def test_answers_in_time_late_and_missing() -> None:
    wire = Wire()
    wire.tick(0)
    wire.answer(0, after_ns=40)
    wire.tick(1, woke_late_ns=7)  # finds the answer to 0
    wire.tick(2)  # finds none: a miss
    wire.answer(1, after_ns=3)  # late, but its time counts: sent at 1107, received at 1203
    wire.tick(3)  # an answer, but not to what was sent last: a miss
    wire.answer(3, after_ns=60)
    wire.tick(5)  # the deadline of 4 was lost; 3 was the last one sent
    assert wire.client.missed == 2
    assert list(wire.client.index) == [0, 1, 2, 3, 5]
    assert list(wire.client.pacing_ns) == [0, 7, 0, 0, 0]
    assert list(wire.client.latency_ns) == [-1, 40, -1, 96, 60]


def test_greeting_stops_at_an_answer_and_is_no_round_trip() -> None:
    wire = Wire()
    assert not wire.client.greet(1000 + 50_000_000)
    assert len(wire.sent) == 3  # every 20 ms
    wire.answer(0, after_ns=10)
    assert wire.client.greet(1_000_000_000_000)
    wire.client.step(Tick(0, 0, 0, 0))
    assert list(wire.client.latency_ns) == [-1] and wire.client.missed == 0


def test_messages_have_the_sizes_of_a_step_and_an_action() -> None:
    wire = Wire()
    wire.tick(258)
    assert [len(payload) for payload in wire.sent] == [STEP_BYTES]
    reply = answer(wire.sent[0])
    assert len(reply) == ACTION_BYTES and reply[:TICK_BYTES] == bytes([2, 1, 0, 0, 0, 0, 0, 0])


def test_quantiles_can_leave_out_the_beginning() -> None:
    result = EchoResult(
        transport="unix",
        hz=2.0,
        rt="off",
        placement="",
        index=np.array([0, 1, 2, 4]),  # tick 2 is due at 1 s
        pacing_ns=np.array([9000, 8000, 1000, 2000]),
        latency_ns=np.array([-1, 90_000, 20_000, -1]),
        missed=1,
        overruns=1,
        skipped=1,
        span_s=2.5,
        steal_s=0.0,
    )
    assert result.latency_us() == {"p50": 20.0, "p99": 90.0, "p999": 90.0, "max": 90.0}
    assert result.latency_us(after_s=1.0) == {"p50": 20.0, "p99": 20.0, "p999": 20.0, "max": 20.0}
    assert result.pacing_us(after_s=1.0) == {"p50": 1.0, "p99": 2.0, "p999": 2.0, "max": 2.0}
    assert result.ticks == 4 and result.miss_ratio == 0.25


@pytest.mark.parametrize("transport", ["zenoh", "unix"])
def test_a_real_pair(transport: str) -> None:
    before = set(Path("/tmp").glob("tenuto-echo-*"))
    result = measure_echo(transport, hz=50.0, seconds=0.4, rt="off")  # type: ignore[arg-type]
    assert result.ticks + result.skipped == 20
    assert len(result.latency_ns) == len(result.pacing_ns) == result.ticks
    seen = result.latency_ns[result.latency_ns >= 0]
    assert len(seen) + result.missed >= result.ticks - 1  # of tick 0 nothing can be missed
    assert len(seen) > 0 and (seen > 0).all()
    assert "collector frozen" in result.placement
    assert set(Path("/tmp").glob("tenuto-echo-*")) <= before


@pytest.mark.parametrize(
    ("transport", "hz", "seconds", "field"),
    [("tcp", 100.0, 1.0, "transport"), ("unix", 0.0, 1.0, "hz"), ("unix", 100.0, float("nan"), "seconds")],
)
def test_wrong_input(transport: str, hz: float, seconds: float, field: str) -> None:
    with pytest.raises(ConfigError, match=f"^{field} = "):
        measure_echo(transport, hz=hz, seconds=seconds)  # type: ignore[arg-type]


def test_a_refusal_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    drop = "setpriv --bounding-set=-all" if os.geteuid() == 0 else ""
    python = tmp_path / "python"
    python.write_text(f'#!/bin/bash\nulimit -r 0\nexec {drop} {sys.executable} "$@"\n')
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    with pytest.raises(EchoError, match="refused SCHED_FIFO"):
        measure_echo("unix", hz=50.0, seconds=0.2, rt="require")
