"""`python -m learner --run DIR`: learn until stopped."""

from __future__ import annotations

import sys

from learner.algorithm import prepare
from learner.power import Levers
from learner.service import LearnerService
from rtcore import channels, realtime
from rtcore.process import Process, background, run_process


def serve(process: Process) -> None:
    """Learn, then write the checkpoint."""
    set_threads = prepare(process.config.learner)
    service = LearnerService(
        process.config,
        process.run_dir,
        process.bus,
        process.clock,
        process.ledger,
        levers=Levers(realtime.allowed_cores(), set_threads, realtime.pin),
        signer=process.keys.signer,
    )
    process.bus.serve(channels.LEARNER, service.command)
    process.bus.declare_alive(channels.LEARNER)
    with (
        background(service.outbox.run, name="outbox", ends=process.stop),
        background(service.keeper.run, name="checkpoints", ends=process.stop),
    ):
        try:
            service.run(process.stop)
        finally:
            service.close()


if __name__ == "__main__":
    sys.exit(run_process(channels.LEARNER, serve))
