"""The agent's process, once it has its resources."""

from __future__ import annotations

from agent_service.evidence import Evidence
from agent_service.kept import Kept
from agent_service.service import AgentService
from rtcore import realtime
from rtcore.process import Process, background


def serve(process: Process) -> None:
    """Act, then account for what never acted."""
    realtime.step_back()  # the bus's threads act; what this one does must not delay a tick of the world
    kept = Kept(process.run_dir, process.ledger, process.clock, process.keys.verifier, process.name)
    evidence = Evidence(process.clock.now_ns, process.continuations.newest_ns)
    service = AgentService(
        process.config,
        process.bus,
        process.clock,
        process.ledger,
        kept.past(),
        evidence,
        process.keys.verifier,
        number=process.part.number,
    )
    process.bus.serve(process.name, service.command)
    process.bus.declare_alive(process.name)
    try:
        with evidence.gathered(), background(service.check_policies, name="policies", ends=process.stop):
            service.run(process.stop)
    finally:  # whatever acting failed with, every policy has its fate
        service.close()
