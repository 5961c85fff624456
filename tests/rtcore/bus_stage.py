"""Zenoh buses of a test, here and in child processes."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.rtcore.bus_samples import ZenohWorld

ROOT = Path(__file__).parents[2]
LIFE_S = 40.0

Child = subprocess.Popen[str]
Spawn = Callable[..., Child]


@contextmanager
def opened() -> Iterator[ZenohWorld]:
    with tempfile.TemporaryDirectory(prefix="tn", dir="/tmp") as directory:
        zenoh_world = ZenohWorld(Path(directory))
        try:
            yield zenoh_world
        finally:
            zenoh_world.close()


@contextmanager
def spawning(world: ZenohWorld) -> Iterator[Spawn]:
    """Start children; whoever lives for too long is killed, so that nobody waits for its words for ever."""
    children: list[Child] = []
    limits: list[threading.Timer] = []

    def start(deed: str, role: str, *arguments: str) -> Child:
        command = [
            sys.executable,
            "-m",
            "tests.rtcore.bus_child",
            deed,
            role,
            str(world.socket_dir),
            *arguments,
        ]
        child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        children.append(child)
        limits.append(threading.Timer(LIFE_S, child.kill))
        limits[-1].daemon = True
        limits[-1].start()
        return child

    try:
        yield start
    finally:
        for limit in limits:
            limit.cancel()
        for child in children:
            child.kill()
            child.communicate()


def ready(child: Child) -> Child:
    assert child.stdout is not None
    assert child.stdout.readline() == "ready\n"
    return child
