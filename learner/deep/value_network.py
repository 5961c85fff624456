"""The state value V of the first soft actor-critic, which Algorithm 2 of the paper prints.

Source: Haarnoja et al. (2018), "Soft Actor-Critic: Off-Policy Maximum Entropy Deep Reinforcement
Learning with a Stochastic Actor". V learns min_i Q_i(s, a) - alpha log pi(a|s) at a drawn from pi, and a
copy Vbar that follows it slowly is what the critics bootstrap from.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from learner.deep.gradients import Mlp, Pass
from learner.deep.networks import Adam, make_networks


class ValueNetwork:
    """V and Vbar, which begin equal.

    Attributes:
        parameters: of V.
        adam: their optimiser.
        target: parameters of Vbar.
    """

    def __init__(
        self, widths: Sequence[int], rows: int, rng: np.random.Generator, lr: float, precision: torch.dtype
    ) -> None:
        self.parameters = make_networks(1, widths, rng)
        self.target = self.parameters.frozen_copy()
        self.adam = Adam(self.parameters.flat, self.parameters.grad, lr)
        self._net, self._target_net = Mlp(self.parameters, precision), Mlp(self.target, precision)
        self._room = Pass(1, rows, widths, precision)
        self._error: Tensor | None = None

    def learn(self, observation: Tensor, soft_value: Tensor) -> None:
        """Descend on J(V) = 1/2 mean (V(s) - soft value)^2, given s, [B, O], and the soft value, [B]."""
        self._room.input.copy_(observation)
        self._error = self._room.forward(self._net)[0, :, 0] - soft_value
        self._room.to_parameters(self._net, (self._error / len(soft_value))[None, :, None])
        self.adam.step()
        self._net.refresh()

    def bootstrap(self, observation: Tensor) -> Tensor:
        """Vbar(s), [B], at s, [B, O]; the next pass overwrites it."""
        self._room.input.copy_(observation)
        return self._room.forward(self._target_net)[0, :, 0]

    def follow(self, tau: float) -> None:
        """Vbar <- tau V + (1 - tau) Vbar."""
        self.target.flat.lerp_(self.parameters.flat, tau)
        self._target_net.refresh()

    def refresh(self) -> None:
        """Take the parameters as they are now, with nothing seen yet."""
        self._net.refresh()
        self._target_net.refresh()
        self._error = None

    def metrics(self) -> dict[str, float]:
        """loss/value: J(V) on the newest batch."""
        return {} if self._error is None else {"loss/value": 0.5 * self._error.square().mean().item()}
