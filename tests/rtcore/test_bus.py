"""What every bus keeps: the same tests for the in-memory one and for Zenoh."""

from __future__ import annotations

import random
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest

from rtcore import channels
from rtcore.bus import BusClosedError, NoAnswerError
from rtcore.channels import ACTION, AGENT, ENV_SERVER, LEARNER, LOG, POLICY, RECORDER, STATS, STEP, Channel
from rtcore.codec import seal
from rtcore.messages import Command, CommandReply
from tests.rtcore.bus_samples import (
    ENV,
    SAMPLES,
    MemoryWorld,
    World,
    ZenohWorld,
    action,
    batch,
    collect,
    eventually,
    meet,
    policy,
    stats,
    step,
)

HOLD = Command(id="c1", verb="hold")


@pytest.fixture(params=["memory", "zenoh"])
def world(request: pytest.FixtureRequest) -> Iterator[World]:
    if request.param == "memory":
        yield MemoryWorld()
        return
    with tempfile.TemporaryDirectory(prefix="tn", dir="/tmp") as directory:
        zenoh_world = ZenohWorld(Path(directory))
        yield zenoh_world
        zenoh_world.close()


def test_every_channel_carries_its_message_unchanged(world: World) -> None:
    sender, receiver = world.bus(ENV_SERVER), world.bus(RECORDER)
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
    bus = world.bus(AGENT)
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


def test_queue_keeps_the_order(world: World) -> None:
    sender, receiver = world.bus(ENV_SERVER), world.bus(LEARNER)
    reader = receiver.queue(LOG, ENV)
    publisher = sender.publisher(LOG, ENV)
    for seq in range(300):
        publisher.put(batch(seq))
    assert collect(reader, until=299) == list(range(300))
    assert reader.dropped == 0


def test_a_full_queue_drops_the_oldest_and_counts(world: World) -> None:
    sender, receiver = world.bus(ENV_SERVER), world.bus(LEARNER)
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
    reader = world.bus(RECORDER).queue(LOG, "*")
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
    reader = world.bus(RECORDER).queue(LOG, ENV)
    assert collect(reader, until=2099) == list(range(100, 2100))


def test_latest_of_a_lossless_channel_starts_with_what_comes(world: World) -> None:
    sender = world.bus(ENV_SERVER).publisher(LOG, ENV)
    sender.put(batch(1))
    receiver = world.bus(LEARNER)
    latest, counter = receiver.latest(LOG, ENV), receiver.queue(LOG, ENV)
    collect(counter, until=1)
    assert latest.take() is None


@pytest.mark.parametrize("reader_first", [True, False])
def test_the_last_of_a_retained_channel_is_there_whoever_starts_first(
    world: World, reader_first: bool
) -> None:
    if reader_first:
        agent, learner = world.bus(AGENT), None
        latest = agent.latest(POLICY)
        learner = world.bus(LEARNER)
    else:
        learner = world.bus(LEARNER)
    publisher = learner.publisher(POLICY)
    for version in (1, 2, 3):
        publisher.put(policy(version, bytes(300_000)))
    if not reader_first:
        latest = world.bus(AGENT).latest(POLICY)

    def newest_is(version: int) -> bool:
        received = latest.wait(0.05)
        return received is not None and received.message.version == version

    assert eventually(lambda: newest_is(3))
    publisher.put(policy(4))
    assert eventually(lambda: newest_is(4))


def test_a_late_queue_of_a_retained_channel_starts_with_the_last(world: World) -> None:
    publisher = world.bus(LEARNER).publisher(POLICY)
    for version in (1, 2, 3):
        publisher.put(policy(version))
    reader = world.bus(RECORDER).queue(POLICY)
    assert reader.wait(5.0)
    publisher.put(policy(4))
    versions: list[int] = []

    def newest_came() -> bool:
        versions.extend(received.message.version for received in reader.drain())
        return 4 in versions

    assert eventually(newest_came)
    assert versions == [3, 4]


def test_retained_data_end_with_the_bus_that_published_them(world: World) -> None:
    keeper, learner = world.bus(ENV_SERVER), world.bus(LEARNER)
    learner.publisher(POLICY).put(policy(1))
    learner.close()
    keeper.publisher(LOG, ENV).put(batch(5))
    late = world.bus(RECORDER)
    policies, batches = late.latest(POLICY), late.queue(LOG, ENV)
    assert collect(batches, until=5) == [5]
    assert policies.take() is None


def test_a_wildcard_hears_every_name_and_a_name_only_its_own(world: World) -> None:
    env, agent, receiver = world.bus(ENV_SERVER), world.bus(AGENT), world.bus(RECORDER)
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


def test_random_bytes_are_counted_and_the_loop_goes_on(world: World) -> None:
    env, agent = world.bus(ENV_SERVER), world.bus(AGENT)
    latest, queue = agent.latest(STEP, ENV), agent.queue(STEP, ENV)
    world.inject(channels.STEP.key_for(ENV), random.Random(1).randbytes(500))
    assert queue.wait(5.0)
    assert queue.drain() == []
    assert latest.wait(0.05) is None
    assert agent.rejected() == {"step": 2}
    meet(env, STEP, queue)
    assert latest.take() is not None


def test_a_damaged_message_is_rejected_though_it_decodes(world: World) -> None:
    agent = world.bus(AGENT)
    queue = agent.queue(STEP, ENV)
    first, second = (seal(msgspec.msgpack.encode(step(seq))) for seq in (1, 2))
    assert len(first) == len(second)
    world.inject(channels.STEP.key_for(ENV), first[:100] + second[100:])
    assert queue.wait(5.0)
    assert queue.drain() == []
    assert agent.rejected() == {"step": 1}


def test_a_bad_message_does_not_end_a_wait(world: World) -> None:
    env, agent = world.bus(ENV_SERVER), world.bus(AGENT)
    latest, counter = agent.latest(STEP, ENV), agent.queue(STEP, ENV)
    meet(env, STEP, counter)
    latest.take()
    good = env.publisher(STEP, ENV)
    result: list[object] = []
    waiter = threading.Thread(target=lambda: result.append(latest.wait(10.0)))
    waiter.start()
    world.inject(channels.STEP.key_for(ENV), b"\xc1")
    assert eventually(lambda: agent.rejected().get("step", 0) >= 1)
    good.put(step(9))
    waiter.join(10.0)
    assert result and result[0] is not None


def test_a_message_of_another_type_is_rejected(world: World) -> None:
    agent = world.bus(AGENT)
    queue = agent.queue(STEP, ENV)
    world.inject(channels.STEP.key_for(ENV), seal(msgspec.msgpack.encode(action())))
    assert queue.wait(5.0)
    assert queue.drain() == []
    assert agent.rejected() == {"step": 1}


def test_an_oversized_message_is_refused_by_the_sender(world: World) -> None:
    publisher = world.bus(AGENT).publisher(ACTION, ENV)
    with pytest.raises(
        ValueError, match=r"channel action: a message of 400\d\d bytes: at most 30000 allowed"
    ):
        publisher.put(action(values=bytes(40_000)))


def test_an_oversized_message_is_dropped_by_the_receiver(world: World) -> None:
    env = world.bus(ENV_SERVER)
    latest, queue = env.latest(ACTION, ENV), env.queue(ACTION, ENV)
    world.inject(channels.ACTION.key_for(ENV), seal(msgspec.msgpack.encode(action(values=bytes(40_000)))))
    assert eventually(lambda: env.rejected() == {"action": 2})
    assert latest.take() is None
    assert queue.drain() == []


def test_the_sender_refuses_a_message_of_another_type(world: World) -> None:
    publisher = world.bus(ENV_SERVER).publisher(STEP, ENV)
    with pytest.raises(TypeError, match="channel step carries Step, not Action"):
        publisher.put(action())  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["", "*", "a/b", "**", "a?b", "a#b"])
def test_a_publisher_needs_a_plain_name(world: World, name: str) -> None:
    with pytest.raises(ValueError, match="name = "):
        world.bus(ENV_SERVER).publisher(STEP, name)


def test_a_command_gets_its_reply(world: World) -> None:
    learner, client = world.bus(LEARNER), world.bus("client")
    seen: list[str] = []

    def handler(command: Command) -> CommandReply:
        seen.append(command.verb)
        return CommandReply(id=command.id, ok=True, text=f"did {command.verb}")

    learner.serve(LEARNER, handler)
    assert client.ask(LEARNER, HOLD) == CommandReply(id="c1", ok=True, text="did hold")
    assert seen == ["hold"]


def test_a_repeated_command_repeats_the_reply_not_the_deed(world: World) -> None:
    learner, client = world.bus(LEARNER), world.bus("client")
    deeds: list[str] = []

    def handler(command: Command) -> CommandReply:
        deeds.append(command.id)
        return CommandReply(id="", ok=True, text=f"deed {len(deeds)}")

    learner.serve(LEARNER, handler)
    first, again = client.ask(LEARNER, HOLD), client.ask(LEARNER, HOLD)
    assert first == again == CommandReply(id="c1", ok=True, text="deed 1")
    assert client.ask(LEARNER, Command(id="c2", verb="hold")).text == "deed 2"
    assert deeds == ["c1", "c2"]


def test_a_handler_that_raises_answers_so(world: World) -> None:
    learner, client = world.bus(LEARNER), world.bus("client")

    def handler(command: Command) -> CommandReply:
        raise RuntimeError("no window yet")

    learner.serve(LEARNER, handler)
    assert client.ask(LEARNER, HOLD) == CommandReply(id="c1", ok=False, text="RuntimeError: no window yet")


def test_nobody_answers(world: World) -> None:
    client = world.bus("client")
    begin = time.monotonic()
    with pytest.raises(NoAnswerError, match=r"learner did not answer 'hold': 2 tries of up to 0\.2 s"):
        client.ask(LEARNER, HOLD, timeout_s=0.2, tries=2)
    assert time.monotonic() - begin < 2.0


def test_commands_to_one_process_do_not_reach_another(world: World) -> None:
    learner, client = world.bus(LEARNER), world.bus("client")
    learner.serve(LEARNER, lambda command: CommandReply(id=command.id, ok=True, text=""))
    with pytest.raises(NoAnswerError):
        client.ask(AGENT, HOLD, timeout_s=0.1, tries=1)


def test_everybody_sees_who_is_alive(world: World) -> None:
    env, agent, learner = world.bus(ENV_SERVER), world.bus(AGENT), world.bus(LEARNER)
    assert env.alive() == frozenset()
    for bus, name in ((env, ENV_SERVER), (agent, AGENT), (learner, LEARNER)):
        bus.declare_alive(name)
    everybody = frozenset({ENV_SERVER, AGENT, LEARNER})
    buses = (env, agent, learner, world.bus("client"))
    assert all(eventually(lambda bus=bus: bus.alive() == everybody) for bus in buses)  # type: ignore[misc]
    agent.close()
    survivors = (buses[0], buses[2], buses[3])
    rest = everybody - {AGENT}
    assert all(eventually(lambda bus=bus: bus.alive() == rest) for bus in survivors)  # type: ignore[misc]
    world.bus(AGENT).declare_alive(AGENT)
    assert all(eventually(lambda bus=bus: bus.alive() == everybody) for bus in survivors)  # type: ignore[misc]


def test_a_wait_ends_in_time(world: World) -> None:
    bus = world.bus(ENV_SERVER)
    latest, queue = bus.latest(STEP, ENV), bus.queue(STEP, ENV)
    begin = time.monotonic()
    assert latest.wait(0.1) is None
    assert not queue.wait(0.1)
    assert 0.2 <= time.monotonic() - begin < 1.0
    assert latest.wait(0.0) is None
    assert not queue.wait(0.0)


def test_a_wait_wakes_at_once(world: World) -> None:
    env, agent = world.bus(ENV_SERVER), world.bus(AGENT)
    queue, latest = agent.queue(STEP, ENV), agent.latest(STEP, ENV)
    meet(env, STEP, queue)
    latest.take()
    publisher = env.publisher(STEP, ENV)
    for reader in (queue, latest):
        timer = threading.Timer(0.1, publisher.put, (step(1),))
        timer.start()
        begin = time.monotonic()
        assert reader.wait(30.0)
        assert time.monotonic() - begin < 5.0
        timer.join()
        queue.drain()


def test_a_closed_bus_says_so(world: World) -> None:
    bus = world.bus(ENV_SERVER)
    plain, advanced = bus.publisher(STEP, ENV), bus.publisher(LOG, ENV)
    begin = time.monotonic()
    bus.close()
    bus.close()
    assert time.monotonic() - begin < 2.0
    with pytest.raises(BusClosedError):
        plain.put(step(0))
    with pytest.raises(BusClosedError):
        advanced.put(batch(0))
    for call in (
        lambda: bus.publisher(STEP, ENV),
        lambda: bus.latest(STEP, ENV),
        lambda: bus.queue(STEP, ENV),
        lambda: bus.ask(LEARNER, HOLD),
        lambda: bus.serve(ENV, lambda command: CommandReply(id="", ok=True, text="")),
        lambda: bus.declare_alive(ENV),
        bus.alive,
    ):
        with pytest.raises(BusClosedError):
            call()
    assert bus.rejected() == {}


def test_what_was_put_before_closing_arrives(world: World) -> None:
    reader = world.bus(RECORDER).queue(LOG, ENV)
    sender = world.bus(ENV_SERVER)
    publisher = sender.publisher(LOG, ENV)
    publisher.put(batch(0))
    collect(reader, until=0)
    for seq in range(1, 200):
        publisher.put(batch(seq))
    sender.close()
    assert collect(reader, until=199, patience_s=3.0) == list(range(1, 200))
