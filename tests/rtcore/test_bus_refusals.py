"""What every bus refuses: the same tests for the in-memory one and for Zenoh."""

from __future__ import annotations

import random
import threading
from dataclasses import replace

import msgspec
import pytest

from rtcore import channels
from rtcore.channels import ACTION, AGENT, ENV_SERVER, LOG, STATS, STEP
from rtcore.codec import seal
from rtcore.messages import Action
from tests.rtcore.bus_samples import (
    ENV,
    World,
    action,
    batch,
    eventually,
    meet,
    stats,
    step,
)


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
    reader = world.bus(ENV_SERVER)
    queue = reader.queue(STEP, ENV)
    first, second = (seal(msgspec.msgpack.encode(step(seq))) for seq in (1, 2))
    assert len(first) == len(second)
    world.inject(channels.STEP.key_for(ENV), first[:100] + second[100:])
    assert queue.wait(5.0)
    assert queue.drain() == []
    assert reader.rejected() == {"step": 1}


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
    reader = world.bus(ENV_SERVER)
    queue = reader.queue(STEP, ENV)
    world.inject(channels.STEP.key_for(ENV), seal(msgspec.msgpack.encode(action())))
    assert queue.wait(5.0)
    assert queue.drain() == []
    assert reader.rejected() == {"step": 1}


def test_an_oversized_message_is_refused_by_the_sender(world: World) -> None:
    publisher = world.bus(ENV_SERVER).publisher(ACTION, ENV)
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


def test_what_the_channels_check_refuses_is_rejected_like_what_does_not_decode(world: World) -> None:
    def check(message: Action) -> None:
        if message.tick > 10:
            raise ValueError(f"tick = {message.tick}: nobody asked for it")

    checked = replace(ACTION, check=check)
    env, agent = world.bus(ENV_SERVER), world.bus(AGENT)
    queue = env.queue(checked, ENV)
    for tick in (11, 3):
        world.inject(channels.ACTION.key_for(ENV), seal(msgspec.msgpack.encode(action(tick=tick))))
    got: list[int] = []

    def arrived() -> bool:
        got.extend(one.message.tick for one in queue.drain())
        return bool(got)

    assert eventually(arrived)
    assert got == [3]
    assert env.rejected() == {"action": 1}
    assert agent.rejected() == {}


@pytest.mark.parametrize("name", ["learner", "*"])
def test_a_message_in_another_ones_name_is_rejected(world: World, name: str) -> None:
    reader = world.bus(ENV_SERVER)
    queue = reader.queue(STATS, name)
    world.inject(STATS.key_for("learner"), seal(msgspec.msgpack.encode(stats("env_server"))))
    assert queue.wait(5.0)
    assert queue.drain() == []
    assert reader.rejected() == {"stats": 1}


def test_a_step_of_another_env_is_rejected(world: World) -> None:
    reader = world.bus(ENV_SERVER)
    queue = reader.queue(LOG, ENV)
    world.inject(LOG.key_for(ENV), seal(msgspec.msgpack.encode(batch(0, env="env1"))))
    assert queue.wait(5.0)
    assert queue.drain() == []
    assert reader.rejected() == {"log": 1}


def test_a_reader_may_refuse_what_is_valid_by_itself(world: World) -> None:
    reader = world.bus(ENV_SERVER)
    reader.reject(STEP, "of the future")
    assert reader.rejected() == {"step": 1}
