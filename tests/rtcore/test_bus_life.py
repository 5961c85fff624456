"""Commands, presence, waits and the end: the same tests for both buses."""

from __future__ import annotations

import threading
import time

import pytest

from rtcore.bus import BusClosedError, NoAnswerError
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, LOG, STEP
from rtcore.messages import Command, CommandReply
from tests.rtcore.bus_samples import (
    ENV,
    World,
    batch,
    eventually,
    meet,
    step,
)

HOLD = Command(id="c1", verb="hold")


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
    env, client = world.bus(ENV_SERVER), world.bus(AGENT)
    deeds: list[str] = []

    def handler(command: Command) -> CommandReply:
        deeds.append(command.id)
        return CommandReply(id="", ok=True, text=f"deed {len(deeds)}")

    env.serve(ENV_SERVER, handler)
    first, again = client.ask(ENV_SERVER, HOLD), client.ask(ENV_SERVER, HOLD)
    assert first == again == CommandReply(id="c1", ok=True, text="deed 1")
    assert client.ask(ENV_SERVER, Command(id="c2", verb="hold")).text == "deed 2"
    assert deeds == ["c1", "c2"]


def test_a_handler_that_raises_answers_so(world: World) -> None:
    env, client = world.bus(ENV_SERVER), world.bus(AGENT)

    def handler(command: Command) -> CommandReply:
        raise RuntimeError("no window yet")

    env.serve(ENV_SERVER, handler)
    assert client.ask(ENV_SERVER, HOLD) == CommandReply(id="c1", ok=False, text="RuntimeError: no window yet")


def test_nobody_answers(world: World) -> None:
    client = world.bus(ENV_SERVER)
    begin = time.monotonic()
    with pytest.raises(NoAnswerError, match=r"learner did not answer 'hold': 2 tries of up to 0\.2 s"):
        client.ask(LEARNER, HOLD, timeout_s=0.2, tries=2)
    assert time.monotonic() - begin < 2.0


def test_commands_to_one_process_do_not_reach_another(world: World) -> None:
    env, client = world.bus(ENV_SERVER), world.bus(AGENT)
    env.serve(ENV_SERVER, lambda command: CommandReply(id=command.id, ok=True, text=""))
    with pytest.raises(NoAnswerError):
        client.ask(LEARNER, HOLD, timeout_s=0.1, tries=1)


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
