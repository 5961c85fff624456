"""The worlds that bus tests run in."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.rtcore.bus_samples import (
    MemoryWorld,
    World,
    ZenohWorld,
)


@pytest.fixture(params=["memory", "zenoh"])
def world(request: pytest.FixtureRequest) -> Iterator[World]:
    if request.param == "memory":
        yield MemoryWorld()
        return
    with tempfile.TemporaryDirectory(prefix="tn", dir="/tmp") as directory:
        zenoh_world = ZenohWorld(Path(directory))
        yield zenoh_world
        zenoh_world.close()
