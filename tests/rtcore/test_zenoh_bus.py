"""What only real processes and real sockets show."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from rtcore.bus import BusError
from rtcore.channels import ACTION, AGENT, ENV_SERVER, LEARNER, LOG, POLICY, RECORDER, SPEC, STEP
from rtcore.messages import StepBatch
from rtcore.monotonic import MonotonicClock
from rtcore.zenoh_bus import open_bus
from rtcore.zenoh_config import Endpoints
from tests.rtcore.bus_samples import ENV, ZenohWorld, batch, eventually, policy, spec, step
from tests.rtcore.bus_stage import Spawn, opened, ready, spawning

CLOCK = MonotonicClock()


@pytest.fixture
def world() -> Iterator[ZenohWorld]:
    with opened() as world:
        yield world


@pytest.fixture
def spawn(world: ZenohWorld) -> Iterator[Spawn]:
    with spawning(world) as spawn:
        yield spawn


def test_readers_stopped_while_they_get_a_history_do_not_delay_the_actions(
    world: ZenohWorld, spawn: Spawn
) -> None:
    env = world.bus(ENV_SERVER)
    steps, actions = env.publisher(STEP, ENV), env.latest(ACTION, ENV)
    log = env.publisher(LOG, ENV)
    for _ in range(1000):
        log.put(StepBatch(steps=[step(0)] * 50))  # 15 MB of history: far more than the sockets hold
    ready(spawn("answer", AGENT))
    assert eventually(lambda: steps.put(step(0)) is None and actions.wait(0.1) is not None)  # type: ignore[func-returns-value]
    for role in (LEARNER, RECORDER):
        reader = ready(spawn("read", role))
        reader.send_signal(signal.SIGSTOP)
    answered = 0
    for seq in range(300):  # 0.6 s: less than BLOCK_US, so that the links are not given up yet
        steps.put(step(seq))
        received = actions.wait(0.002)
        answered += received is not None
    # With one receiving worker: 0 answered.
    assert answered > 200


def test_a_stopped_reader_and_a_blocked_put_do_not_delay_the_end(world: ZenohWorld, spawn: Spawn) -> None:
    env = world.bus(ENV_SERVER)
    log = env.publisher(LOG, ENV)
    reader = ready(spawn("read", RECORDER))
    log.put(batch(0))
    assert reader.stdout is not None
    assert int(reader.stdout.readline()) == 0
    reader.send_signal(signal.SIGSTOP)
    put_ns = [time.monotonic_ns()]
    ended: list[BaseException] = []

    def flood() -> None:
        try:
            while True:
                log.put(StepBatch(steps=[step(0)] * 200))
                put_ns[0] = time.monotonic_ns()
        except BusError as error:
            ended.append(error)

    thread = threading.Thread(target=flood)
    thread.start()
    assert eventually(lambda: time.monotonic_ns() - put_ns[0] > 300_000_000)  # it blocks
    begin = time.monotonic()
    env.close()
    assert time.monotonic() - begin < 2.0
    thread.join(2.0)
    assert ended


@pytest.mark.parametrize(("deed", "code"), [("leave", 0), ("fail", 1)])
def test_a_process_ends_at_once_and_says_nothing_of_its_own(
    world: ZenohWorld, spawn: Spawn, deed: str, code: int
) -> None:
    world.bus(ENV_SERVER)  # somebody to connect to
    child = spawn(deed, AGENT)
    begin = time.monotonic()
    output, errors = child.communicate(timeout=20.0)
    assert time.monotonic() - begin < 10.0
    assert child.returncode == code
    assert output == ("4\n" if deed == "leave" else "")  # the receiving workers of zenoh_config.RUNTIME
    assert ("on purpose" in errors) == (deed == "fail")
    assert "zenoh" not in errors.replace("zenoh_bus", "")


def test_a_role_runs_once(world: ZenohWorld) -> None:
    world.bus(AGENT)
    with pytest.raises(BusError, match=r"agent_service cannot join the run in .*does it run already"):
        world.bus(AGENT)


@pytest.mark.parametrize("role", [ENV_SERVER, RECORDER, "client"])
def test_opening_does_not_wait_for_the_others(world: ZenohWorld, role: str) -> None:
    begin = time.monotonic()
    world.bus(role)
    assert time.monotonic() - begin < 1.0


def test_further_endpoints_connect_what_shares_no_directory(world: ZenohWorld) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    elsewhere = world.socket_dir / "b"
    elsewhere.mkdir(0o700)
    with (
        open_bus(
            LEARNER, "run", world.socket_dir, clock=CLOCK, endpoints=Endpoints(listen=(endpoint,))
        ) as learner,
        open_bus(AGENT, "run", elsewhere, clock=CLOCK, endpoints=Endpoints(connect=(endpoint,))) as agent,
        open_bus(
            RECORDER, "other", elsewhere, clock=CLOCK, endpoints=Endpoints(connect=(endpoint,))
        ) as stranger,
    ):
        learner.publisher(POLICY).put(policy(5))
        policies, foreign = agent.latest(POLICY), stranger.latest(POLICY)
        received = policies.wait(5.0)
        assert received is not None and received.message.version == 5
        assert foreign.wait(0.3) is None  # the run's name is in the keys


def test_a_socket_left_behind_is_taken_over(world: ZenohWorld) -> None:
    with world.bus(ENV_SERVER) as first:
        first.publisher(SPEC, ENV).put(spec())
    with world.bus(ENV_SERVER) as second:
        second.publisher(SPEC, ENV).put(spec())
        assert world.bus(AGENT).latest(SPEC, ENV).wait(5.0) is not None


def test_a_signal_handler_ends_a_wait(world: ZenohWorld) -> None:
    class InterruptedWaitError(Exception):
        pass

    def handle(number: int, frame: object) -> None:
        raise InterruptedWaitError

    previous = signal.signal(signal.SIGUSR1, handle)
    latest = world.bus(AGENT).latest(STEP, ENV)
    timer = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGUSR1))
    begin = time.monotonic()
    try:
        timer.start()
        with pytest.raises(InterruptedWaitError):
            latest.wait(20.0)
    finally:
        timer.join()
        signal.signal(signal.SIGUSR1, previous)
    assert time.monotonic() - begin < 2.0
