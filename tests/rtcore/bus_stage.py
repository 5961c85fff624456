"""Zenoh buses of a test, here and in child processes."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.rtcore.bus_samples import ZenohWorld

ROOT = Path(__file__).parents[2]

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
    """Start a child and wait until it is connected."""
    children: list[Child] = []

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
        return child

    try:
        yield start
    finally:
        for child in children:
            child.kill()
            child.communicate()


def ready(child: Child) -> Child:
    assert child.stdout is not None
    assert child.stdout.readline() == "ready\n"
    return child
