"""What the learner publishes is signed: on the bus and in the file alike."""

from __future__ import annotations

from pathlib import Path

import msgspec

from learner.outbox import Outbox
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Policy
from rtcore.run_dir import RunDir
from tests.agent_service.rig import policy


class Scribe:
    """Signs with its name."""

    def sign(self, policy: Policy) -> Policy:
        return msgspec.structs.replace(policy, signature=b"scribe")


def test_a_policy_is_signed_before_anybody_gets_it(tmp_path: Path) -> None:
    run_dir, clock, hub = RunDir.create(tmp_path / "run", RunConfig()), VirtualClock(5), MemoryHub()
    bus = hub.bus(channels.LEARNER, clock)
    reader = bus.queue(channels.POLICY)
    outbox = Outbox(bus, run_dir, clock, Ledger(channels.LEARNER, 1), Scribe())
    outbox.put(policy(3))
    outbox.flush()
    (received,) = reader.drain()
    kept = run_dir.read_policy()
    assert kept is not None
    assert received.message.signature == kept.signature == b"scribe"
    assert msgspec.structs.replace(kept, signature=b"") == policy(3)
