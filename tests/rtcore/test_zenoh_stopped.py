"""Readers and publishers that are killed or stopped for a while: what Zenoh brings, and to whom."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import pytest

from rtcore.channels import ENV_SERVER, LOG, RECORDER, SPEC
from rtcore.messages import StepBatch
from rtcore.zenoh_config import socket_path
from tests.rtcore.bus_child import BATCHES
from tests.rtcore.bus_samples import ENV, ZenohWorld, batch, collect, eventually, step
from tests.rtcore.bus_stage import Spawn, opened, ready, spawning


def numbers_of(incarnation: int) -> list[int]:
    return list(range(incarnation * 1000, incarnation * 1000 + BATCHES))


def a_killed_publisher_comes_back_and_nothing_it_sent_then_is_lost(world: ZenohWorld, spawn: Spawn) -> None:
    recorder = world.bus(RECORDER)
    batches, specs = recorder.queue(LOG, ENV), recorder.latest(SPEC, ENV)
    env = ready(spawn("publish", ENV_SERVER, "1"))
    assert collect(batches, until=1399) == numbers_of(1)
    assert specs.take() is not None
    assert eventually(lambda: ENV_SERVER in recorder.alive())
    env.kill()  # SIGKILL: its socket file stays
    env.wait()
    assert eventually(lambda: ENV_SERVER not in recorder.alive())
    assert socket_path(world.socket_dir, ENV_SERVER).exists()
    ready(spawn("publish", ENV_SERVER, "2"))
    assert collect(batches, until=2399) == numbers_of(2)
    assert specs.wait(5.0) is not None
    assert eventually(lambda: ENV_SERVER in recorder.alive())


def a_killed_reader_comes_back_and_gets_everything(world: ZenohWorld, spawn: Spawn) -> None:
    publisher = world.bus(ENV_SERVER).publisher(LOG, ENV)
    first = ready(spawn("read", RECORDER))
    for seq in range(200):
        publisher.put(batch(seq))
    assert first.stdout is not None
    assert [int(first.stdout.readline()) for _ in range(200)] == list(range(200))
    first.kill()
    first.wait()
    for seq in range(200, 400):
        publisher.put(batch(seq))
    second = ready(spawn("read", RECORDER))
    for seq in range(400, 600):
        publisher.put(batch(seq))
    assert second.stdout is not None
    assert [int(second.stdout.readline()) for _ in range(600)] == list(range(600))


def a_reader_stopped_beyond_the_lease_gets_everything_afterwards(world: ZenohWorld, spawn: Spawn) -> None:
    publisher = world.bus(ENV_SERVER).publisher(LOG, ENV)
    reader = ready(spawn("read", RECORDER))
    assert reader.stdout is not None
    publisher.put(batch(0))
    assert int(reader.stdout.readline()) == 0
    reader.send_signal(signal.SIGSTOP)
    for seq in range(1, 41):  # 4 s; the lease is 3 s
        publisher.put(batch(seq))
        time.sleep(0.1)
    reader.send_signal(signal.SIGCONT)
    for seq in range(41, 60):
        publisher.put(batch(seq))
        time.sleep(0.02)
    assert [int(reader.stdout.readline()) for _ in range(59)] == list(range(1, 60))


def what_still_waits_to_be_sent_at_the_end_arrives(world: ZenohWorld, spawn: Spawn) -> None:
    sender = world.bus(ENV_SERVER)
    publisher = sender.publisher(LOG, ENV)
    reader = ready(spawn("read", RECORDER))
    assert reader.stdout is not None
    publisher.put(batch(0))
    assert reader.stdout.readline() == "0\n"
    reader.send_signal(signal.SIGSTOP)
    for seq in range(1, 21):  # 0.26 MB: more than the socket holds, less than what blocks a put (0.28 MB)
        publisher.put(StepBatch(steps=[step(seq)] * 50))
    wake = threading.Timer(0.2, reader.send_signal, (signal.SIGCONT,))
    wake.start()
    sender.close()
    wake.join()
    time.sleep(0.5)
    reader.kill()
    assert [line.split()[0] for line in reader.stdout] == [str(seq) for seq in range(1, 21)]


def a_reader_given_up_under_a_full_queue_gets_everything_undamaged(world: ZenohWorld, spawn: Spawn) -> None:
    publisher = world.bus(ENV_SERVER).publisher(LOG, ENV)
    reader = ready(spawn("read", RECORDER))
    assert reader.stdout is not None
    publisher.put(batch(0))
    assert reader.stdout.readline() == "0\n"
    reader.send_signal(signal.SIGSTOP)
    for seq in range(
        1, 101
    ):  # 1.5 MB: more than the socket holds, so that the link is given up in mid-message
        publisher.put(StepBatch(steps=[step(seq)] * 60))
    reader.send_signal(signal.SIGCONT)
    time.sleep(0.1)
    for seq in range(101, 111):
        publisher.put(StepBatch(steps=[step(seq)] * 60))
    lines = [reader.stdout.readline().split() for _ in range(110)]
    assert lines == [[str(seq)] * 60 for seq in range(1, 111)]


# What mostly waits for Zenoh, or for others to die; all of it at once.
STORIES: tuple[Callable[[ZenohWorld, Spawn], None], ...] = (
    a_killed_publisher_comes_back_and_nothing_it_sent_then_is_lost,
    a_killed_reader_comes_back_and_gets_everything,
    a_reader_stopped_beyond_the_lease_gets_everything_afterwards,
    what_still_waits_to_be_sent_at_the_end_arrives,
    a_reader_given_up_under_a_full_queue_gets_everything_undamaged,
)


@pytest.fixture(scope="module")
def played() -> dict[str, Future[None]]:
    def play(story: Callable[[ZenohWorld, Spawn], None]) -> None:
        with opened() as world, spawning(world) as spawn:
            story(world, spawn)

    with ThreadPoolExecutor(len(STORIES)) as pool:
        return {story.__name__: pool.submit(play, story) for story in STORIES}


@pytest.mark.parametrize("name", [story.__name__ for story in STORIES])
def test_what_takes_its_time(name: str, played: dict[str, Future[None]]) -> None:
    played[name].result()
