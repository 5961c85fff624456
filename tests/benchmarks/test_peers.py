from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from benchmarks import act_path
from benchmarks.peer_loop import ACTION_DIM, OBSERVATION_DIM, Actor, Asker, make_step, pace
from benchmarks.peers import TRANSPORTS, WAITING, Transport, connect, serve
from rtcore.clock import VirtualClock
from rtcore.config import ConfigError
from rtcore.lifecycle import Stop
from rtcore.messages import Action

MS = 1_000_000


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_every_request_is_answered_in_order(transport: Transport, tmp_path: Path) -> None:
    stop, ready, answers = Stop(), threading.Event(), list[bytes]()
    arguments = (transport, tmp_path / "s", lambda request: request + b"!", stop, ready.set)
    server = threading.Thread(target=serve, args=arguments)
    server.start()
    assert ready.wait(10)
    numbers: list[bytes] = []

    def greet() -> bool:  # what is sent before the way back stands is lost
        send(b"hello")
        return bool(answers)

    def on_answer(answer: bytes) -> None:
        (answers if answer == b"hello!" else numbers).append(answer)

    try:
        with connect(transport, tmp_path / "s", on_answer) as send:
            until(greet)
            for number in range(20):
                send(b"%d" % number)
                if transport in WAITING:
                    assert len(numbers) == number + 1
            until(lambda: len(numbers) == 20)
    finally:
        stop.set("done")
        server.join(10)
    assert not server.is_alive()
    assert numbers == [b"%d!" % number for number in range(20)]


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.005)


def test_an_unknown_transport_is_refused_by_name(tmp_path: Path) -> None:
    with (
        pytest.raises(ConfigError, match="transport = 'pigeon': must be one of grpc-unary"),
        connect("pigeon", tmp_path / "s", print),  # type: ignore[arg-type]
    ):
        pass


class Far:
    """Somebody who answers after so many ms of waiting; None: never."""

    def __init__(self, clock: VirtualClock, asker: Asker, delays_ms: list[float | None]) -> None:
        self.clock, self.asker, self.delays_ms = clock, asker, delays_ms

    def send(self, request: bytes) -> None:
        delay_ms = self.delays_ms.pop(0)
        if delay_ms is None:
            return
        tick = msgspec.msgpack.decode(request)[3]
        self.clock.advance_ns(round(delay_ms * MS))
        action = Action(
            env="env0", incarnation=1, tick=tick, values=b"", policy_version=1, received_ns=0, sent_ns=0
        )
        self.asker.on_answer(msgspec.msgpack.encode(action))


def test_a_loop_lasts_from_sending_to_the_answers_arrival() -> None:
    clock = VirtualClock()
    asker = Asker(clock, waits=True)
    found = pace(asker, Far(clock, asker, [0.25, 0.5, 0.25, 0.25]).send, clock, hz=500, seconds=0.008)
    assert (found.ticks, found.missed, found.overruns) == (4, 0, 0)
    assert asker.loop.count == 3  # the last one's answer is nobody's any more
    assert found.loop_us["max"] == 500.0
    assert found.pacing_us["max"] == 0.0


def test_no_answer_is_a_miss_and_a_long_wait_costs_the_deadlines_that_it_lasted() -> None:
    clock = VirtualClock()
    asker = Asker(clock, waits=True)
    # Period 2 ms. Tick 1 is not answered: tick 2 misses. Tick 2 waits 3 ms: tick 3 misses, and begins 1 ms
    # late. It waits 4 ms and ends at D_3 + 5 ms: tick 4 is lost, tick 5 begins 1 ms late and misses.
    far = Far(clock, asker, [0.5, None, 3.0, 4.0, 0.5, 0.5])
    found = pace(asker, far.send, clock, hz=500, seconds=0.014)
    assert far.delays_ms == []
    assert (found.ticks, found.overruns) == (6, 1)
    assert found.missed == 1 + 1 + 1 + 1
    assert found.pacing_us["max"] == pytest.approx(1000.0)
    assert found.more["late_share"] == pytest.approx(2 / 6)


def test_an_answer_that_comes_while_the_sender_goes_on_is_taken_at_the_next_tick() -> None:
    clock = VirtualClock()
    asker = Asker(clock, waits=False)
    found = pace(asker, Far(clock, asker, [0.5, None, 3.0, 0.5]).send, clock, hz=500, seconds=0.008)
    assert found.missed == 1  # tick 2; at tick 3, late as it is, the answer is there


def test_the_actor_answers_the_step_that_it_was_asked() -> None:
    actor = Actor(VirtualClock(7))
    observation = np.ones(OBSERVATION_DIM, np.float32).tobytes()
    request = msgspec.msgpack.encode(make_step(5, 3, observation))
    action = msgspec.msgpack.decode(actor.answer(request), type=Action)
    values = np.frombuffer(action.values, np.float32)
    assert (action.tick, action.incarnation, action.received_ns) == (5, 3, 7)
    assert values.shape == (ACTION_DIM,)
    assert (np.abs(values) < 1).all()
    assert values.any()


def test_two_real_processes_make_a_loop() -> None:
    arguments = act_path.Arguments(hz=(100.0,), seconds=0.3, rt="off")
    found = act_path.measure("zeromq-async", 100.0, arguments)
    assert found.ticks + found.missed >= 30
    assert found.loop_us["p50"] is not None
    assert found.more["placement"].startswith("SCHED_OTHER")
