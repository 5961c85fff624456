"""`python -m env_server --run DIR`: be the world until the duration is over or somebody says stop."""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import replace

from env_server.service import EnvService
from env_server.worlds import make_world, resolve
from rtcore import channels
from rtcore.config import ConfigError
from rtcore.process import background, open_process


def main() -> int:
    """Open, tick, close. Returns the exit code: 0 done, 2 wrong input."""
    try:
        _serve()
    except ConfigError as error:
        sys.stderr.write(f"env_server: {error}\n")
        return 2
    return 0


def _serve() -> None:
    with open_process(channels.ENV_SERVER) as process:
        bus, stop = process.bus, process.stop
        config = replace(process.config, env=resolve(process.config.env))
        with closing(make_world(config.env, config.seed)) as world:
            world.save_scene(process.run_dir.world_path)
            service = EnvService(config, world, bus, process.clock, process.ledger, process.incarnation)
            bus.serve(channels.ENV_SERVER, lambda command: service.command(command, stop))
            bus.declare_alive(channels.ENV_SERVER)
            with background(service.journal.run, name="journal"):
                try:
                    service.run(stop)
                finally:
                    service.close()


if __name__ == "__main__":
    sys.exit(main())
