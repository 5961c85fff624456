"""`python -m agent_service.spare ...`: load what an agent needs, wait for an order, then be that agent.

Most of an agent's start is loading; `launcher.spares` has one loaded in reserve. The order is a line of JSON
on stdin: `command`, the agent's command line, and `output`, the file for what it prints. Without an order it
ends with whoever holds the other end of stdin.

Its own arguments are not read. They tell `ps` which run it is for, and are the room for the agent's command
line: whoever looks for the processes of a run (`launcher.chaos.faults.Lives`) must find it by that, and not
before.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import sys

from rtcore import command_line

NO_ORDER = 0


def main() -> int:
    """Load, wait, serve; returns the exit code."""
    at_interrupt = signal.signal(signal.SIGINT, signal.SIG_DFL)  # until there is something to end in order
    os.putenv("OPENBLAS_NUM_THREADS", "1")  # both as in `__main__`
    gc.disable()
    import numpy.random  # noqa: F401 - NumPy itself loads it when it is first used

    from agent_service.serving import serve
    from rtcore import channels
    from rtcore.process import FAILED, parse, run_process

    parse(channels.AGENT, ["--run", ""])  # argparse, too, loads parts of itself when they are first used
    try:
        command_line.room()  # else it is of no use, and better gone before it gets an order
        line = sys.stdin.readline()
        if not line.strip():
            return NO_ORDER
        arguments = _obey(line)
    except (ValueError, KeyError, TypeError, OSError) as error:
        sys.stderr.write(f"{channels.AGENT}: its spare cannot take over: {error!r}\n")
        return FAILED  # so that the next life begins from nothing
    signal.signal(signal.SIGINT, at_interrupt)
    return run_process(channels.AGENT, serve, arguments)


def _obey(line: str) -> list[str]:
    """Take the place of the process that was ordered; its arguments."""
    order = json.loads(line)
    command, output = [str(word) for word in order["command"]], str(order["output"])
    arguments = command[command.index("-m") + 2 :]
    command_line.replace(command)
    for descriptor, path, flags in (
        (0, os.devnull, os.O_RDONLY),
        (1, output, os.O_WRONLY | os.O_CREAT | os.O_APPEND),
    ):
        opened = os.open(path, flags, 0o666)
        os.dup2(opened, descriptor)
        os.close(opened)
    os.dup2(1, 2)
    return arguments


if __name__ == "__main__":
    sys.exit(main())
