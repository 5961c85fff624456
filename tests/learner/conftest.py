from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rtcore.run_dir import RunDir
from tests.learner.service_rig import CONFIG


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """As the learner runs: bit-equal results, and no threads that fight over little nets."""
    torch.set_num_threads(1)


@pytest.fixture
def run_dir(tmp_path: Path) -> RunDir:
    """Of the service under test."""
    return RunDir.create(tmp_path / "run", CONFIG)
