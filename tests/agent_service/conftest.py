from __future__ import annotations

import pytest

from rtcore.memory_bus import MemoryHub
from tests.agent_service.rig import Rig


@pytest.fixture
def rig() -> Rig:
    return Rig(MemoryHub())
