"""A batch from the replay, as PyTorch sees it."""

from __future__ import annotations

import torch

from learner.replay import Batch


class BatchTensors:
    """The arrays of a batch as tensors that share their memory."""

    def __init__(self, batch: Batch) -> None:
        self.observation = torch.from_numpy(batch.observation)
        self.action = torch.from_numpy(batch.action)
        self.reward = torch.from_numpy(batch.reward)
        self.next_observation = torch.from_numpy(batch.next_observation)
        self.terminated = torch.from_numpy(batch.terminated)
