from __future__ import annotations

import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """As the learner runs: bit-equal results, and no threads that fight over little nets."""
    torch.set_num_threads(1)
