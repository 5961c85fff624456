"""What only the in-memory bus promises, and the parts that both buses are made of."""

from __future__ import annotations

import logging
import threading

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcore import channels, commands
from rtcore.channels import LOG, STATS, STEP
from rtcore.clock import VirtualClock
from rtcore.codec import Codec, Rejections, seal
from rtcore.inbox import QueueInbox, ThreadBell
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Command, CommandReply, Message
from tests.rtcore.bus_samples import ENV, SAMPLES, batch, stats, step

MS = 1_000_000


def test_messages_are_stamped_by_the_readers_virtual_clock() -> None:
    hub, env_clock, agent_clock = MemoryHub(), VirtualClock(5), VirtualClock(70)
    reader = hub.bus("agent", agent_clock).latest(STEP, ENV)
    hub.bus("env", env_clock).publisher(STEP, ENV).put(step(1))
    agent_clock.advance_ns(1)
    received = reader.take()
    assert received is not None and received.received_ns == 70


def test_a_wait_on_a_virtual_clock_lets_the_time_pass_and_no_more() -> None:
    hub, clock = MemoryHub(), VirtualClock()
    bus = hub.bus("agent", clock)
    latest, queue = bus.latest(STEP, ENV), bus.queue(STEP, ENV)
    assert latest.wait(0.025) is None
    assert clock.now_ns() == 25 * MS
    assert not queue.wait(0.010)
    assert clock.now_ns() == 35 * MS
    bus.publisher(STEP, ENV).put(step(1))
    assert latest.wait(1.0) is not None
    assert queue.wait(1.0)
    assert clock.now_ns() == 35 * MS  # nothing to wait for


def test_late_history_keeps_the_order_of_all_publishers() -> None:
    hub, clock = MemoryHub(), VirtualClock()
    bus = hub.bus("env", clock)
    first, second = bus.publisher(LOG, "a"), bus.publisher(LOG, "b")
    for seq, publisher in enumerate((first, second, second, first)):
        publisher.put(batch(seq, env="a" if publisher is first else "b"))
    drained = hub.bus("recorder", clock).queue(LOG, "*").drain()
    assert [received.message.steps[0].seq for received in drained] == [0, 1, 2, 3]


def test_a_closed_bus_hears_no_more() -> None:
    hub, clock = MemoryHub(), VirtualClock()
    agent, env = hub.bus("agent", clock), hub.bus("env", clock)
    reader, publisher = agent.queue(STEP, ENV), env.publisher(STEP, ENV)
    publisher.put(step(1))
    agent.close()
    publisher.put(step(2))
    assert [received.message.seq for received in reader.drain()] == [1]


def test_many_threads_lose_nothing_uncounted() -> None:
    hub, clock = MemoryHub(), VirtualClock()
    reader = hub.bus("recorder", clock).queue(STATS, "*", capacity=100)

    def send(process: str) -> None:
        publisher = hub.bus(process, clock).publisher(STATS, process)
        for seq in range(200):
            publisher.put(stats(process, seq))

    threads = [threading.Thread(target=send, args=(name,)) for name in channels.PROCESSES]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert reader.dropped == 700
    assert len(reader.drain()) == 100


@pytest.mark.parametrize("channel", channels.TABLE, ids=lambda channel: channel.name)
def test_no_bytes_whatever_raise_in_decode(channel: channels.Channel[Message]) -> None:
    valid = msgspec.msgpack.encode(SAMPLES[channel.name][1])
    codec = Codec(channel, Rejections(lambda: 0))

    @given(
        st.one_of(
            st.binary(max_size=300),
            st.builds(lambda at, byte: valid[:at] + byte + valid[at + 1 :], st.integers(0, 400), st.binary()),
        )
    )
    def decode(encoded: bytes) -> None:
        assert codec.decode(encoded) is None  # no checksum
        message = codec.decode(seal(encoded))
        assert message is None or isinstance(message, channel.type)

    decode()
    assert codec.decode(b"") is None
    assert codec.decode(seal(b"")) is None
    assert codec.decode(seal(b"\x91" * 100_000)) is None  # nested beyond any stack
    assert codec.decode(seal(valid)) == SAMPLES[channel.name][1]


def test_rejections_are_counted_each_and_logged_at_a_limited_rate(caplog: pytest.LogCaptureFixture) -> None:
    clock = VirtualClock()
    rejections = Rejections(clock.now_ns)
    with caplog.at_level(logging.WARNING):
        for _ in range(1000):
            rejections.count("step", "bad")
        rejections.count("action", "bad")
        clock.advance_ns(11_000 * MS)
        rejections.count("step", "worse")
    assert rejections.counts() == {"step": 1001, "action": 1}
    assert [record.getMessage() for record in caplog.records] == [
        "channel step: message rejected: bad",
        "channel action: message rejected: bad",
        "channel step: message rejected: worse (999 more like it were not logged)",
    ]


def test_a_queue_needs_room() -> None:
    codec = Codec(STEP, Rejections(lambda: 0))
    with pytest.raises(ValueError, match="capacity = 0: must be at least 1"):
        QueueInbox(codec, 0, ThreadBell(), lambda: 0)


def test_a_bell_rung_often_wakes_once() -> None:
    bell = ThreadBell()
    bell.ring()
    bell.ring()
    assert bell.wait(1.0)
    assert not bell.wait(0.01)


def test_a_server_remembers_a_bounded_number_of_replies() -> None:
    deeds: list[str] = []

    def handler(command: Command) -> CommandReply:
        deeds.append(command.id)
        return CommandReply(id=command.id, ok=True, text="")

    server = commands.CommandServer(handler, Rejections(lambda: 0))
    ids = [f"c{number}" for number in range(commands.REMEMBERED + 1)]
    for command_id in ids:
        server.answer(msgspec.msgpack.encode(Command(id=command_id, verb="hold")))
    server.answer(msgspec.msgpack.encode(Command(id=ids[-1], verb="hold")))  # remembered
    server.answer(msgspec.msgpack.encode(Command(id=ids[0], verb="hold")))  # forgotten
    assert deeds == [*ids, ids[0]]


@pytest.mark.parametrize("payload", [b"", b"\xc1", bytes(70_000), msgspec.msgpack.encode(["c1", "explode"])])
def test_what_is_no_command_is_counted_and_not_answered(payload: bytes) -> None:
    rejections = Rejections(lambda: 0)
    server = commands.CommandServer(lambda command: CommandReply(id="", ok=True, text=""), rejections)
    assert server.answer(payload) is None
    assert rejections.counts() == {"control": 1}


def test_a_reply_to_another_command_is_not_accepted() -> None:
    rejections = Rejections(lambda: 0)
    client = commands.CommandClient(Command(id="c1", verb="stop"), rejections)
    foreign, own = (CommandReply(id=reply_id, ok=True, text="") for reply_id in ("c2", "c1"))
    assert client.accept(msgspec.msgpack.encode(foreign)) is None
    assert client.accept(msgspec.msgpack.encode(own)) == own
    assert rejections.counts() == {"control": 1}
