"""`python -m agent_service --run DIR`: act until stopped."""

from __future__ import annotations

import sys

from agent_service.evidence import Evidence
from agent_service.kept import Kept
from agent_service.service import AgentService
from rtcore import channels
from rtcore.process import Process, background, run_process


def serve(process: Process) -> None:
    """Act, then account for what never acted."""
    kept = Kept(process.run_dir, process.ledger, process.clock, process.verifier)
    last_published = kept.newest()
    evidence = Evidence(process.clock.now_ns, process.continuations.newest_ns)
    service = AgentService(
        process.config,
        process.bus,
        process.clock,
        process.ledger,
        last_published,
        evidence,
        process.verifier,
        kept.keep,
    )
    process.bus.serve(channels.AGENT, service.command)
    process.bus.declare_alive(channels.AGENT)
    with evidence.gathered(), background(service.check_policies, name="policies", ends=process.stop):
        service.run(process.stop)
    service.close()


if __name__ == "__main__":
    sys.exit(run_process(channels.AGENT, serve))
