"""The ports on which the processes of one run on one machine meet, where their links are secured.

Whoever comes first chooses them and writes them down beside where the unix sockets would be.
"""

from __future__ import annotations

import hashlib
import os
import socket
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import msgspec

from rtcore.channels import PROCESSES
from rtcore.config import ConfigError
from rtcore.files import write_once
from rtcore.socket_dir import PORTS

HOST = "127.0.0.1"
# Below the ports that Linux gives to outgoing connections (32768 and up by default): a process that starts
# again must find its own free.
FIRST, LAST = 20_000, 32_000


def local_ports(directory: Path, processes: Sequence[str] = PROCESSES) -> dict[str, int]:
    """Process name -> port on the loopback, the same for all who ask with the same directory.

    Args:
        directory: of the run's sockets.
        processes: the names of all processes of the run.

    Raises:
        ConfigError: what is written there is not that, or no ports are free.
    """
    path = directory / PORTS
    if not path.exists():
        with suppress(FileExistsError):  # another process was faster
            write_once(path, msgspec.json.encode(_free_ports(path, processes)))
    try:
        found = msgspec.json.decode(path.read_bytes(), type=dict[str, int])
        return {process: found[process] for process in processes}
    except (OSError, KeyError, msgspec.DecodeError) as error:
        raise ConfigError("link", str(path), f"must hold a port for each process ({error})") from error


def _free_ports(path: Path, processes: Sequence[str]) -> dict[str, int]:
    """Consecutive ports, from a place that follows from the path: two runs seldom try the same."""
    digest = hashlib.sha256(os.fsencode(path.resolve())).digest()
    span, count = LAST - FIRST - len(processes), len(processes)
    begin = int.from_bytes(digest[:4]) % span
    for step in range(0, span, count):
        first = FIRST + (begin + step) % span
        ports = range(first, first + count)
        if _are_free(ports):
            return dict(zip(processes, ports, strict=True))
    raise ConfigError("link", str(path), f"needs {count} free ports in {FIRST}..{LAST} on {HOST}")


def _are_free(ports: range) -> bool:
    with ExitStack() as stack:
        for port in ports:
            probe = stack.enter_context(socket.socket())
            try:
                probe.bind((HOST, port))
            except OSError:
                return False
    return True
