"""How the agent's process ends."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent_service import serving
from agent_service.service import AgentService
from rtcore import channels
from rtcore.cast import Part
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Continuations, Stop
from rtcore.memory_bus import MemoryHub
from rtcore.process import Keys, Process
from rtcore.run_dir import RunDir
from rtcore.signing import NoSigner, NoVerifier
from tests.agent_service.rig import SPEC, policy


def test_a_policy_that_is_ready_when_acting_fails_has_its_fate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub, clock, ledger = MemoryHub(), VirtualClock(1_000), Ledger(channels.AGENT, 1)
    run = RunDir.create(tmp_path / "run", RunConfig())
    bus = hub.bus(channels.AGENT, clock)
    process = Process(
        Part(channels.AGENT),
        RunConfig(),
        run,
        clock,
        bus,
        ledger,
        Stop(),
        1,
        Continuations(clock.now_ns),
        Keys(NoSigner(), NoVerifier()),
    )
    specs = hub.bus(channels.ENV_SERVER, clock).publisher(channels.SPEC, "env0")
    policies = hub.bus(channels.LEARNER, clock).publisher(channels.POLICY)

    def fail(service: AgentService, stop: Stop) -> None:
        specs.put(SPEC)
        policies.put(policy(1))
        service.poll_policies()
        raise RuntimeError("acting failed")

    monkeypatch.setattr(AgentService, "run", fail)
    monkeypatch.setattr(AgentService, "check_policies", lambda service, stop: None)
    monkeypatch.setattr("rtcore.realtime.step_back", lambda: None)
    with pytest.raises(RuntimeError, match="acting failed"):
        serving.serve(process)
    assert [ledger.counter(f"policies.{name}") for name in ("received", "unused")] == [1, 1]
