"""`tenuto router`: a Zenoh router, for processes and operators on other machines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from rich.console import Console
from tyro.conf import UseAppendAction

from launcher.cli import DONE, CommandError
from launcher.parsing import parse
from rtcore.bus import BusError
from rtcore.config import ConfigError
from rtcore.lifecycle import Stop, stop_on_signals
from rtcore.zenoh_session import open_router

DEFAULT_LISTEN = ("tcp/127.0.0.1:7447",)
WAIT_S = 3600.0


@dataclass(frozen=True)
class RouterOptions:
    """Where to listen."""

    listen: Annotated[tuple[str, ...], UseAppendAction] = ()
    """An endpoint to listen on; may be given several times. None: tcp/127.0.0.1:7447."""


def router(argv: Sequence[str]) -> int:
    """`tenuto router`."""
    description = (
        "A Zenoh router: the processes of a run connect to it besides (--connect), and those elsewhere reach "
        "them through it (--router). It says nothing itself, and knows no secured links."
    )
    chosen = parse(RouterOptions, argv, prog="tenuto router", description=description)
    listen = chosen.listen or DEFAULT_LISTEN
    stop = Stop()
    with stop_on_signals(stop):
        try:
            session = open_router(listen)
        except ValueError as error:
            raise ConfigError("listen", " ".join(listen), str(error)) from error
        except BusError as error:
            raise CommandError(str(error)) from error
        with session:
            Console().print(f"router  {', '.join(listen)}", highlight=False, soft_wrap=True)
            while not stop.wait(WAIT_S):
                pass
    return DONE
