"""The weight of the entropy in the soft Q function: fixed, or tuned (Haarnoja et al. 2018, section 5)."""

from __future__ import annotations

import math
from typing import Literal

from torch import Tensor

from learner.deep.networks import Adam, FlatParameters


class Temperature:
    """alpha. Tuned, it starts from 1 and descends on J(alpha) = -log(alpha) mean(log pi + target entropy).

    Attributes:
        tuned: whether it moves.
        parameters: log alpha, [1]; not read where it is fixed.
        adam: their optimiser.
    """

    def __init__(self, alpha: float | Literal["auto"], lr: float, target_entropy: float) -> None:
        self.tuned = alpha == "auto"
        self.parameters = FlatParameters({"log_alpha": (1,)})
        self.adam = Adam(self.parameters.flat, self.parameters.grad, lr)
        self._fixed = 1.0 if alpha == "auto" else alpha
        self._target_entropy = target_entropy
        self._stepped_from: Tensor | None = None

    @property
    def value(self) -> float:
        """Of the next update's losses."""
        return math.exp(self.parameters.flat[0].item()) if self.tuned else self._fixed

    def step(self, log_prob: Tensor) -> None:
        """Descend, given log pi of the policy's actions, [B]."""
        if not self.tuned:
            return
        self._stepped_from = self.parameters.flat[0].clone()
        self.parameters.grad[0] = -(log_prob.mean() + self._target_entropy)
        self.adam.step()

    def forget(self) -> None:
        """Nothing has been seen yet: `loss` has nothing to say."""
        self._stepped_from = None

    def loss(self, entropy: float) -> float | None:
        """J(alpha) of the newest step, given the mean of -log pi it saw; None without one."""
        if self._stepped_from is None:
            return None
        return self._stepped_from.item() * (entropy - self._target_entropy)
