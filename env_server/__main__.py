"""`python -m env_server --run DIR`: be the world until the duration is over or somebody says stop."""

from __future__ import annotations

import sys
from contextlib import closing

from env_server.announcing import Past
from env_server.service import EnvService
from env_server.worlds.registry import make_world
from rtcore import channels
from rtcore.process import Process, background, run_process


def serve(process: Process) -> None:
    """Make the world, tick, close."""
    config, bus, stop = process.config, process.bus, process.stop
    with closing(make_world(config.env, config.seed)) as world:
        if process.part.number == 0:  # a fleet's worlds look alike
            world.save_scene(process.run_dir.world_path)
        service = EnvService(
            config,
            world,
            bus,
            process.clock,
            process.ledger,
            process.incarnation,
            past=Past(process.run_dir, part=process.part),
            resumed_ns=process.continuations.all_ns,
        )
        bus.serve(process.name, lambda command: service.command(command, stop))
        bus.declare_alive(process.name)
        with background(service.journal.run, name="journal", ends=process.stop):
            try:
                service.run(stop)
            finally:
                service.close()


if __name__ == "__main__":
    sys.exit(run_process(channels.ENV_SERVER, serve))
