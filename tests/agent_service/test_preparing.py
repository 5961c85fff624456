"""Before its first answer an agent that starts again has looked at the policies that are there."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from agent_service import service
from agent_service.adoption import Past
from agent_service.service import AgentService
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Action
from tests.agent_service.rig import SPEC, policy, step

LIMIT_S = 20.0


class Scene:
    """An agent's two loops, to be begun one by one, and an env server that has declared itself."""

    def __init__(self, past: Past) -> None:
        hub, clock = MemoryHub(), VirtualClock(1_000)
        env = hub.bus(channels.ENV_SERVER, clock)
        self.policies = hub.bus(channels.LEARNER, clock).publisher(channels.POLICY)
        bus = hub.bus(channels.AGENT, clock)
        self.agent = AgentService(RunConfig(), bus, clock, Ledger(channels.AGENT, 1), past)
        self._actions = env.queue(channels.ACTION, "env0")
        self._steps = env.publisher(channels.STEP, "env0")
        env.publisher(channels.SPEC, "env0").put(SPEC)

    def answer(self, tick: int) -> Action | None:
        self._steps.put(step(tick))
        answers = self._actions.drain()
        return answers[0].message if answers else None

    def first_answer(self) -> Action:
        deadline = time.monotonic() + LIMIT_S
        while time.monotonic() < deadline:
            answer = self.answer(1)
            if answer is not None:
                return answer
            time.sleep(0.001)
        raise AssertionError("no answer")

    @contextmanager
    def running(self) -> Iterator[Stop]:
        """`run` alone; whoever takes the stop may run `check_policies` beside it."""
        stop = Stop()
        acting = threading.Thread(target=self.agent.run, args=(stop,))
        acting.start()
        try:
            yield stop
        finally:
            stop.set("over")
            self.agent._prepared.set()
            acting.join(LIMIT_S)


@contextmanager
def checking(agent: AgentService, stop: Stop) -> Iterator[None]:
    thread = threading.Thread(target=agent.check_policies, args=(stop,))
    thread.start()
    try:
        yield
    finally:
        stop.set("over")
        thread.join(LIMIT_S)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "PREPARE_S", LIMIT_S)


@pytest.mark.usefixtures("patient")
def test_it_answers_nothing_before_and_then_by_the_newest() -> None:
    scene = Scene(Past(newest=policy(9), floor=9))
    with scene.running() as stop:
        time.sleep(0.02)
        assert scene.answer(0) is None
        with checking(scene.agent, stop):
            assert scene.first_answer().policy_version == 9


@pytest.mark.usefixtures("patient")
def test_without_a_file_it_waits_for_the_bus() -> None:
    scene = Scene(Past(floor=9))
    with scene.running() as stop, checking(scene.agent, stop):
        time.sleep(0.02)
        assert scene.answer(0) is None
        scene.policies.put(policy(10))
        assert scene.first_answer().policy_version == 10


@pytest.mark.usefixtures("patient")
def test_in_a_run_without_policies_it_waits_for_none() -> None:
    scene = Scene(Past())
    with scene.running() as stop, checking(scene.agent, stop):
        assert scene.first_answer().policy_version == 0


def test_it_does_not_wait_for_ever() -> None:
    scene = Scene(Past(floor=9))
    with scene.running() as stop, checking(scene.agent, stop):
        assert scene.first_answer().policy_version == 0
