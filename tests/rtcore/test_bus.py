"""What every bus delivers: the same tests for the in-memory one and for Zenoh.

Roles are those whose Zenoh sessions open at once: the env server waits for nobody, the agent for it alone.
"""

from __future__ import annotations

import threading
import time
from contextlib import closing
from typing import Any

import pytest

from rtcore import channels
from rtcore.bus import Received
from rtcore.channels import ACTION, AGENT, ENV_SERVER, LEARNER, LOG, POLICY, RECORDER, STATS, STEP, Channel
from rtcore.messages import Step, StepBatch
from tests.rtcore.bus_samples import (
    ENV,
    SAMPLES,
    MemoryWorld,
    World,
    action,
    batch,
    collect,
    eventually,
    meet,
    policy,
    stats,
    step,
)


def test_every_channel_carries_its_message_unchanged(world: World) -> None:
    sender, receiver = world.bus(ENV_SERVER), world.bus(AGENT)
    assert {channel.name for channel in channels.TABLE} == set(SAMPLES)
    for channel in channels.TABLE:
        untyped: Channel[Any] = channel
        name, message = SAMPLES[channel.name]
        reader, publisher = receiver.queue(untyped, name), sender.publisher(untyped, name)
        before = time.monotonic_ns()
        publisher.put(message)
        while not reader.wait(0.2):
            publisher.put(message)
        received = reader.drain()[0]
        assert received.message == message, channel.name
        assert before < received.received_ns < time.monotonic_ns()
    assert receiver.rejected() == {}


def test_a_process_hears_itself(world: World) -> None:
    bus = world.bus(ENV_SERVER)
    reader = bus.latest(STATS, "*")
    bus.publisher(STATS, AGENT).put(stats(AGENT))
    received = reader.wait(5.0)
    assert received is not None and received.message.process == AGENT


def test_latest_gives_the_newest_once(world: World) -> None:
    sender, receiver = world.bus(ENV_SERVER), world.bus(AGENT)
    latest, counter = receiver.latest(STEP, ENV), receiver.queue(STEP, ENV)
    meet(sender, STEP, counter)
    publisher = sender.publisher(STEP, ENV)
    for seq in range(1, 51):
        publisher.put(step(seq))
        time.sleep(0.001)  # a busy machine drops from a burst
    while not any(received.message.seq == 50 for received in counter.drain()):
        if not counter.wait(0.5):
            publisher.put(step(50))
    received = latest.take()
    assert received is not None and received.message == step(50)
    assert latest.take() is None


def test_who_attends_answers_on_the_thread_that_receives(world: World) -> None:
    env, agent = world.bus(ENV_SERVER), world.bus(AGENT)
    answers = env.queue(ACTION, ENV)
    publisher = agent.publisher(ACTION, ENV)
    threads: set[int] = set()

    def answer(received: Received[Step]) -> None:
        threads.add(threading.get_ident())
        publisher.put(action(received.message.seq))

    agent.attend(STEP, ENV, answer)
    steps = env.publisher(STEP, ENV)
    sent = 0
    while not answers.wait(0.2):  # the first are lost while the two get to know each other
        sent += 1
        steps.put(step(sent))
    answers.drain()
    for seq in range(100, 120):
        steps.put(step(seq))
        assert answers.wait(5.0)
        assert [received.message.tick for received in answers.drain()][-1] == seq
    assert threading.get_ident() not in threads or isinstance(world, MemoryWorld)


def test_only_what_cannot_wait_is_attended_and_nothing_bad_is_heard(world: World) -> None:
    bus = world.bus(ENV_SERVER)
    with pytest.raises(ValueError, match="log is lossless: only realtime is attended"):
        bus.attend(LOG, ENV, lambda received: None)
    if isinstance(world, MemoryWorld):
        heard: list[Step] = []
        bus.attend(STEP, ENV, lambda received: heard.append(received.message))
        world.inject(f"env/{ENV}/step", b"nonsense")
        bus.publisher(STEP, ENV).put(step(3))
        assert heard == [step(3)]
        assert bus.rejected() == {"step": 1}


def test_queue_keeps_the_order(world: World) -> None:
    sender, receiver = world.bus(ENV_SERVER), world.bus(AGENT)
    reader = receiver.queue(LOG, ENV)
    publisher = sender.publisher(LOG, ENV)
    for seq in range(300):
        publisher.put(batch(seq))
    assert collect(reader, until=299) == list(range(300))
    assert reader.dropped == 0


def test_a_full_queue_drops_the_oldest_and_counts(world: World) -> None:
    sender, receiver = world.bus(ENV_SERVER), world.bus(AGENT)
    small, counter = receiver.queue(LOG, ENV, capacity=10), receiver.queue(LOG, ENV)
    publisher = sender.publisher(LOG, ENV)
    for seq in range(25):
        publisher.put(batch(seq))
    collect(counter, until=24)
    assert eventually(lambda: small.dropped == 15)
    assert collect(small, until=24) == list(range(15, 25))


def test_a_late_reader_gets_all_of_a_lossless_channel(world: World) -> None:
    publisher = world.bus(ENV_SERVER).publisher(LOG, ENV)
    for seq in range(100):
        publisher.put(batch(seq))
    reader = world.bus(AGENT).queue(LOG, "*")
    for seq in range(100, 200):
        publisher.put(batch(seq))
    assert collect(reader, until=199) == list(range(200))


def test_a_reader_that_waits_gets_all_of_a_lossless_publisher_that_comes(world: World) -> None:
    reader = world.bus(RECORDER).queue(LOG, "*")
    for incarnation in (1, 2, 3):  # the env server starts, ends, and starts again
        with closing(world.bus(ENV_SERVER)) as bus:
            publisher = bus.publisher(LOG, ENV)
            for seq in range(150):
                publisher.put(batch(incarnation * 1000 + seq, incarnation))
                time.sleep(0.002)  # so that the connection comes in mid-stream
            last = incarnation * 1000 + 149
            assert collect(reader, until=last) == list(range(last - 149, last + 1))


def test_lossless_history_is_the_newest_2000(world: World) -> None:
    publisher = world.bus(ENV_SERVER).publisher(LOG, ENV)
    for seq in range(2100):
        publisher.put(batch(seq))
    reader = world.bus(AGENT).queue(LOG, ENV)
    assert collect(reader, until=2099) == list(range(100, 2100))


def test_latest_of_a_lossless_channel_starts_with_what_comes(world: World) -> None:
    sender = world.bus(ENV_SERVER).publisher(LOG, ENV)
    sender.put(batch(1))
    receiver = world.bus(AGENT)
    latest, counter = receiver.latest(LOG, ENV), receiver.queue(LOG, ENV)
    collect(counter, until=1)
    assert latest.take() is None


@pytest.mark.parametrize("reader_first", [True, False])
def test_the_last_of_a_retained_channel_is_there_whoever_starts_first(
    world: World, reader_first: bool
) -> None:
    if reader_first:
        latest = world.bus(ENV_SERVER).latest(POLICY)
    publisher = world.bus(AGENT).publisher(POLICY)
    for version in (1, 2, 3):
        publisher.put(policy(version, bytes(300_000)))
    if not reader_first:
        latest = world.bus(ENV_SERVER).latest(POLICY)

    def newest_is(version: int) -> bool:
        received = latest.wait(0.05)
        return received is not None and received.message.version == version

    assert eventually(lambda: newest_is(3))
    publisher.put(policy(4))
    assert eventually(lambda: newest_is(4))


def test_a_late_queue_of_a_retained_channel_starts_with_the_last(world: World) -> None:
    publisher = world.bus(ENV_SERVER).publisher(POLICY)
    for version in (1, 2, 3):
        publisher.put(policy(version))
    reader = world.bus(AGENT).queue(POLICY)
    assert reader.wait(5.0)
    publisher.put(policy(4))
    versions: list[int] = []

    def newest_came() -> bool:
        versions.extend(received.message.version for received in reader.drain())
        return 4 in versions

    assert eventually(newest_came)
    assert versions == [3, 4]


def test_retained_data_end_with_the_bus_that_published_them(world: World) -> None:
    keeper, other = world.bus(ENV_SERVER), world.bus(AGENT)
    other.publisher(POLICY).put(policy(1))
    other.close()
    keeper.publisher(LOG, ENV).put(batch(5))
    late = world.bus(LEARNER)
    policies, batches = late.latest(POLICY), late.queue(LOG, ENV)
    assert collect(batches, until=5) == [5]
    assert policies.take() is None


def test_a_wildcard_hears_every_name_and_a_name_only_its_own(world: World) -> None:
    env, agent, receiver = world.bus(ENV_SERVER), world.bus(AGENT), world.bus(LEARNER)
    everyone, one = receiver.queue(STATS, "*"), receiver.queue(STATS, AGENT)
    publishers = [bus.publisher(STATS, name) for bus, name in ((env, ENV_SERVER), (agent, AGENT))]
    heard: set[str] = set()

    def all_heard() -> bool:
        for publisher, name in zip(publishers, (ENV_SERVER, AGENT), strict=True):
            publisher.put(stats(name))
        heard.update(r.message.process for r in everyone.drain())
        return heard == {ENV_SERVER, AGENT}

    assert eventually(all_heard)
    assert eventually(lambda: one.wait(0.1))
    assert {r.message.process for r in one.drain()} == {AGENT}


def test_what_was_put_before_closing_arrives(world: World) -> None:
    reader = world.bus(ENV_SERVER).queue(LOG, ENV)
    sender = world.bus(AGENT)
    publisher = sender.publisher(LOG, ENV)
    publisher.put(batch(0))
    collect(reader, until=0)
    for seq in range(1, 100):
        publisher.put(StepBatch(steps=[step(seq)] * 60))  # 15 kB
    sender.close()
    assert collect(reader, until=99, patience_s=3.0)[::60] == list(range(1, 100))
