"""`python -m agent_service --run DIR`: act until stopped."""

from __future__ import annotations

from agent_service.service import AgentService
from rtcore import channels
from rtcore.process import background, open_process


def main() -> None:
    """Open, act, close."""
    with open_process(channels.AGENT) as process:
        service = AgentService(process.config, process.bus, process.clock, process.ledger)
        process.bus.serve(channels.AGENT, service.command)
        process.bus.declare_alive(channels.AGENT)
        try:
            with background(service.check_policies, name="policies"):
                service.run(process.stop)
        finally:
            service.close()


if __name__ == "__main__":
    main()
