"""Two hosts on one machine: network namespaces, a cable between them, and a worse line beside it.

Needs root and `ip`. The cable is a pair of virtual interfaces, which can be cut. The line is a TUN interface
in each namespace and a process that carries the packets from one to the other, later or not at all: what
`tc netem` does, which not every kernel has.
"""

from __future__ import annotations

import fcntl
import heapq
import os
import random
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from rtcore.libc import setns

SIDES = ("a", "b")
CABLE, LINE = "cable0", "line0"
CABLE_ADDRESS = {"a": "10.77.0.1", "b": "10.77.0.2"}
LINE_ADDRESS = {"a": "10.78.0.1", "b": "10.78.0.2"}
NAMESPACES = Path("/run/netns")
MAX_PACKET = 1 << 16
READY = b"ready\n"
PRIORITY = 60  # before the processes of a run, at 50: a wire waits for nobody
# <linux/if_tun.h>
TUNSETIFF = 0x400454CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000


def missing() -> str:
    """What this machine lacks for it; empty: nothing."""
    if os.geteuid() != 0:
        return "needs root"
    return "" if shutil.which("ip") else "needs the command ip"


@dataclass(frozen=True)
class TwoHosts:
    """The namespaces of both sides. Made by `two_hosts`."""

    name: str

    def namespace(self, side: str) -> str:
        """How `ip netns` calls it."""
        return f"{self.name}{side}"

    def command(self, side: str, command: Sequence[str]) -> list[str]:
        """`command`, to be run on one side."""
        return ["ip", "netns", "exec", self.namespace(side), *command]

    def cut(self) -> None:
        """Pull the cable."""
        self.ip("a", "link", "set", CABLE, "down")

    def restore(self) -> None:
        """Plug the cable in again."""
        self.ip("a", "link", "set", CABLE, "up")

    @contextmanager
    def line(self, *, delay_s: float, loss: float, seed: int = 0) -> Iterator[None]:
        """A second connection, at LINE_ADDRESS, for as long as the block runs.

        Args:
            delay_s: of every packet, one way.
            loss: share of packets, either way, that never arrive.
            seed: of which those are.
        """
        command = [
            sys.executable,
            "-m",
            "launcher.chaos.netlab",
            self.name,
            str(delay_s),
            str(loss),
            str(seed),
        ]
        pump = subprocess.Popen(command, stdout=subprocess.PIPE)
        try:
            assert pump.stdout is not None
            if pump.stdout.readline() != READY:
                raise OSError("the line could not be made")
            for side, other in zip(SIDES, reversed(SIDES), strict=True):
                ends = (LINE_ADDRESS[side], "peer", LINE_ADDRESS[other])
                self.ip(side, "addr", "add", *ends, "dev", LINE)
                self.ip(side, "link", "set", LINE, "up")
            yield
        finally:
            pump.send_signal(signal.SIGTERM)
            pump.wait()

    def ip(self, side: str, *arguments: str) -> None:
        """Configure one side's network.

        Raises:
            OSError: refused.
        """
        _run("ip", "-n", self.namespace(side), *arguments)


@contextmanager
def two_hosts() -> Iterator[TwoHosts]:
    """Two namespaces with a cable between them; whatever happens, they are removed.

    Raises:
        OSError: they cannot be made.
    """
    hosts = TwoHosts(f"tenuto{os.getpid()}")
    with ExitStack() as undo:
        for side in SIDES:
            _run("ip", "netns", "add", hosts.namespace(side))
            undo.callback(_run, "ip", "netns", "del", hosts.namespace(side))
        ends = [[CABLE, "netns", hosts.namespace(side)] for side in SIDES]
        _run("ip", "link", "add", *ends[0], "type", "veth", "peer", "name", *ends[1])
        for side in SIDES:
            hosts.ip(side, "addr", "add", f"{CABLE_ADDRESS[side]}/24", "dev", CABLE)
            for interface in (CABLE, "lo"):
                hosts.ip(side, "link", "set", interface, "up")
        yield hosts


def pump(name: str, delay_s: float, loss: float, seed: int) -> None:
    """Carry packets between both sides' TUN interfaces until terminated."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    hosts = TwoHosts(name)
    ends = [_open_tun(hosts.namespace(side)) for side in SIDES]
    other = {ends[0]: ends[1], ends[1]: ends[0]}
    chance = random.Random(seed)
    waiting: list[tuple[float, int, int, bytes]] = []  # (due, number, where to, packet)
    number = 0
    sys.stdout.buffer.write(READY)
    sys.stdout.flush()
    while True:
        timeout_s = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        for end in select.select(ends, [], [], timeout_s)[0]:
            packet = os.read(end, MAX_PACKET)
            if chance.random() >= loss:
                number += 1
                heapq.heappush(waiting, (time.monotonic() + delay_s, number, other[end], packet))
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, end, packet = heapq.heappop(waiting)
            with suppress(OSError):  # that side is not up yet: lost, as on a wire
                os.write(end, packet)


def _open_tun(namespace: str) -> int:
    """A TUN interface in a namespace; this thread is in it from now on."""
    with (NAMESPACES / namespace).open() as handle:
        setns(handle.fileno())
    end = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(end, TUNSETIFF, struct.pack("16sH14x", LINE.encode(), IFF_TUN | IFF_NO_PI))
    return end


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip()}")


if __name__ == "__main__":
    pump(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
