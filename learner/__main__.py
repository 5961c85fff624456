"""`python -m learner --run DIR`: learn until stopped."""

from __future__ import annotations

import torch

from learner.memory import keep_freed_memory
from learner.service import LearnerService
from rtcore import channels
from rtcore.process import background, open_process


def main() -> None:
    """Open, learn, close."""
    with open_process(channels.LEARNER) as process:
        torch.set_num_threads(process.config.learner.threads)
        keep_freed_memory()
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
