"""`python -m recorder --run DIR`: record until stopped."""

from __future__ import annotations

from recorder.service import RecorderService
from rtcore import channels
from rtcore.process import open_process


def main() -> None:
    """Open, record, close."""
    with open_process(channels.RECORDER) as process:
        service = RecorderService(process.config, process.run_dir, process.bus, process.clock, process.ledger)
        process.bus.serve(channels.RECORDER, service.command)
        process.bus.declare_alive(channels.RECORDER)
        try:
            service.run(process.stop)
        finally:
            service.close()


if __name__ == "__main__":
    main()
