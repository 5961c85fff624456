"""`python -m learner --run DIR`: learn until stopped."""

from __future__ import annotations

from learner.arithmetic import prepare
from learner.service import LearnerService
from rtcore import channels
from rtcore.process import background, open_process


def main() -> None:
    """Open, learn, close."""
    with open_process(channels.LEARNER) as process:
        prepare(process.config.learner.threads)
        service = LearnerService(process.config, process.run_dir, process.bus, process.clock, process.ledger)
        process.bus.serve(channels.LEARNER, service.command)
        process.bus.declare_alive(channels.LEARNER)
        with background(service.outbox.run, name="outbox"):
            try:
                service.run(process.stop)
            finally:
                service.close()


if __name__ == "__main__":
    main()
