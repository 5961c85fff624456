"""The bus over TLS with access control: what it must still do, and how it ends."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import pytest

from launcher import keys
from rtcore import cast
from rtcore.bus import BusError
from rtcore.channels import ACTION, AGENT, ENV_SERVER, LEARNER, LOG, POLICY, PROCESSES, RECORDER, SPEC, STATS
from rtcore.config import EnvConfig, RunConfig
from rtcore.messages import Command, CommandReply, StepBatch
from rtcore.monotonic import MonotonicClock
from rtcore.zenoh_bus import ZenohBus, open_bus
from rtcore.zenoh_session import CLOSE_LIMIT_S, CLOSING
from tests.rtcore.bus_samples import ENV, ZenohWorld, batch, collect, eventually, policy, spec, stats, step

ROOT = Path(__file__).parents[2]


class SecuredWorld:
    """Sessions with a certificate each."""

    def __init__(self, place: Path) -> None:
        self.keys, self.socket_dir = place / "keys", place
        keys.make(self.keys, now=datetime.now(UTC))
        self.opened: list[ZenohBus] = []

    def bus(self, process: str, peers: Sequence[str] = PROCESSES) -> ZenohBus:
        clock, secure = MonotonicClock(), str(self.keys)
        bus = open_bus(process, ZenohWorld.RUN, self.socket_dir, clock=clock, peers=peers, secure=secure)
        self.opened.append(bus)
        return bus


@pytest.fixture
def world() -> Iterator[SecuredWorld]:
    with tempfile.TemporaryDirectory(prefix="tn", dir="/tmp") as place:
        found = SecuredWorld(Path(place))
        yield found
        for bus in found.opened:
            bus.close()


def test_everybody_may_do_what_its_role_does(world: SecuredWorld) -> None:
    env, learner = world.bus(ENV_SERVER), world.bus(LEARNER)
    log = env.publisher(LOG, ENV)
    env.publisher(SPEC, ENV).put(spec())
    for seq in range(50):
        log.put(batch(seq))
    learner.publisher(POLICY).put(policy(3))
    agent, recorder = world.bus(AGENT), world.bus(RECORDER)  # late: they get the history
    assert collect(recorder.queue(LOG, ENV), until=49) == list(range(50))
    assert agent.latest(SPEC, ENV).wait(5.0) is not None
    assert agent.queue(POLICY).wait(5.0)
    for bus, role in ((env, ENV_SERVER), (agent, AGENT), (learner, LEARNER), (recorder, RECORDER)):
        bus.declare_alive(role)
        bus.serve(role, lambda command: CommandReply(id=command.id, ok=True, text="done"))
    assert eventually(lambda: env.alive() == recorder.alive() == set(PROCESSES))
    operator = world.bus("client")
    assert all(operator.ask(role, Command(id=role, verb="status")).ok for role in PROCESSES)
    begin = time.monotonic()
    for bus in reversed(world.opened):
        bus.close()
    assert time.monotonic() - begin < 2.0


def test_a_fleet_meets_under_the_certificates_of_its_roles(world: SecuredWorld) -> None:
    names = cast.names(RunConfig(env=EnvConfig(count=2)))
    buses = {name: world.bus(name, names) for name in names}
    for name, bus in buses.items():
        bus.declare_alive(name)
        bus.serve(name, lambda command: CommandReply(id=command.id, ok=True, text="done"))
    assert eventually(lambda: all(bus.alive() == set(names) for bus in buses.values()))
    operator = world.bus("client", names)
    assert all(operator.ask(name, Command(id=name, verb="status")).ok for name in names)
    reader = buses[RECORDER].queue(STATS, "*")
    mine = buses["agent_service.1"].publisher(STATS, "agent_service.1")
    foreign = buses["agent_service.1"].publisher(STATS, "env_server.1")
    heard: set[str] = set()

    def both_told() -> bool:
        foreign.put(stats("env_server.1"))
        mine.put(stats("agent_service.1"))
        reader.wait(0.2)
        heard.update(one.message.process for one in reader.drain())
        return bool(heard)

    assert eventually(both_told) and not eventually(lambda: both_told() and len(heard) > 1, 0.3)
    assert heard == {"agent_service.1"}


def test_what_is_not_its_own_goes_nowhere(world: SecuredWorld) -> None:
    env, agent, recorder = world.bus(ENV_SERVER), world.bus(AGENT), world.bus(RECORDER)
    policies, specs, batches = agent.queue(POLICY), agent.latest(SPEC, ENV), agent.queue(LOG, ENV)
    recorder.publisher(POLICY).put(policy(9))  # with a cache that answers for it
    recorder.publisher(LOG, ENV).put(batch(9))
    recorder.declare_alive(LEARNER)
    env.publisher(SPEC, ENV).put(spec())
    assert specs.wait(5.0) is not None
    late = agent.queue(POLICY)  # asks all caches
    assert not late.wait(0.5) and not policies.drain() and not batches.drain()
    assert agent.alive() == frozenset()
    assert env.queue(ACTION, ENV).drain() == []


def test_a_stopped_reader_delays_the_end_by_seconds_at_most(world: SecuredWorld) -> None:
    """Zenoh tries for 10 s to close its link."""
    env = world.bus(ENV_SERVER)
    log = env.publisher(LOG, ENV)
    child = [sys.executable, "-m", "tests.rtcore.bus_child", "read", RECORDER, str(world.socket_dir), "1"]
    with subprocess.Popen([*child, str(world.keys)], cwd=ROOT, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        assert reader.stdout.readline() == "ready\n"
        log.put(batch(0))
        assert int(reader.stdout.readline()) == 0
        reader.send_signal(signal.SIGSTOP)
        put_ns = [time.monotonic_ns()]

        def flood() -> None:
            try:
                while True:
                    log.put(StepBatch(steps=[step(0)] * 200))
                    put_ns[0] = time.monotonic_ns()
            except BusError:
                pass

        threading.Thread(target=flood).start()
        assert eventually(lambda: time.monotonic_ns() - put_ns[0] > 300_000_000)  # it blocks
        begin = time.monotonic()
        env.close()
        assert time.monotonic() - begin < CLOSE_LIMIT_S + 2.0
        reader.kill()
    for thread in threading.enumerate():
        if thread.name == CLOSING:
            thread.join(15)  # or it would come back from Zenoh while the interpreter ends
