"""`python -m recorder --run DIR`: record until stopped."""

from __future__ import annotations

import sys

from recorder.service import RecorderService
from rtcore import channels
from rtcore.process import Process, run_process


def serve(process: Process) -> None:
    """Record, then finish the file."""
    service = RecorderService(process.config, process.run_dir, process.bus, process.clock, process.ledger)
    process.bus.serve(channels.RECORDER, service.command)
    process.bus.declare_alive(channels.RECORDER)
    try:
        service.run(process.stop)
    finally:
        service.close()


if __name__ == "__main__":
    sys.exit(run_process(channels.RECORDER, serve))
