"""A forecast distilled: one network in the place of a weighted sum of many.

The policy's step against Qtilde of l_p snapshots passes through 2 l_p networks; against the distilled
forecast it passes through one. The network begins as the first critic with the snapshots' weights applied
to their parameters: to first order in the parameters' differences, that is Qtilde already. Then it learns
from the policy's exact steps, whose values are its labels and cost nothing more: all of the first ones in
a window, afterwards every so many, so that it follows the policy to the actions that matter.

HalfCheetah at 200 Hz (128 x 128, l_p = 10, ten units ahead, unit 45): its error at the policy's own actions
was 0.51 spreads of Qtilde at first, 0.20 after ten fits, and stayed at 0.19 to 0.23 while the policy moved
on for 2000 steps. Begun from random parameters it was above 1.4 after 800 fits. Its slope in the action,
which is what the policy climbs, agrees much less than its value: a cosine of 0.3 with the exact one, less
than the newest critic's own 0.5. Both are measured while it works.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from learner.deep.gradients import Mlp, Pass
from learner.deep.networks import Adam, FlatParameters, make_networks

FIRST_FITS = 32  # policy steps that are exact at a window's start; ten were enough for the error above
FIT_EVERY = 16  # afterwards; at l_p = 10 an exact step costs five to six plain ones
LEARNING_RATE = 1e-3


class Distilled:
    """The network, and how well it stands in.

    Attributes:
        parameters: of the network, one critic's shape.
        adam: their optimiser.
        steps: of the policy, since the window's start.
    """

    def __init__(self, widths: Sequence[int], rows: int, precision: torch.dtype) -> None:
        self.parameters = make_networks(1, widths, None)
        self.adam = Adam(self.parameters.flat, self.parameters.grad, LEARNING_RATE)
        self.steps = 0
        self._net = Mlp(self.parameters, precision)
        self._room = Pass(1, rows, widths, precision)
        self._up = torch.ones(1, rows, 1)
        self._seen: tuple[Tensor, Tensor, Tensor, Tensor] | None = None

    def restart(self, weights: Sequence[float], critics: Sequence[FlatParameters]) -> None:
        """Begin a window whose forecast is the sum of so weighted twin critics."""
        values = self.parameters.views(self.parameters.flat)
        self.parameters.flat.zero_()
        for weight, critic in zip(weights, critics, strict=True):
            for name, view in critic.views(critic.flat).items():
                values[name].add_(view[:1], alpha=weight)
        for moments in (self.adam.moment1, self.adam.moment2, self.adam.steps):
            moments.zero_()
        self.steps, self._seen = 0, None
        self.refresh()

    def refresh(self) -> None:
        """Take the parameters as they are now."""
        self._net.refresh()

    def due(self) -> bool:
        """Whether the policy's next step should be exact."""
        return self.steps < FIRST_FITS or self.steps % FIT_EVERY == 0

    def climb(self, inputs: Tensor, action_dim: int) -> tuple[Tensor, Tensor]:
        """Its values at `inputs` [B, in], [B], and their gradient in the action, [B, A]."""
        self._room.input.copy_(inputs)
        value = self._room.forward(self._net)[0, :, 0]
        return value, self._room.to_input(self._net, self._up, action_dim)[0].float()

    def fit(self, inputs: Tensor, value: Tensor, slope: Tensor) -> None:
        """Learn from an exact step: `value` [B] and `slope` [B, A] of the forecast at `inputs`.

        What it says there before is kept first, to be judged: the batch is new to it.
        """
        guess, guessed_slope = self.climb(inputs, slope.shape[1])
        error = guess - value
        self._seen = error, value, slope, guessed_slope
        self._room.to_parameters(self._net, (error / len(error))[None, :, None])
        self.adam.step()
        self.refresh()

    def judged(self) -> dict[str, float]:
        """Of the newest exact step: see `Fsac.metrics`. Nothing before the first one of a window."""
        if self._seen is None:
            return {}
        error, value, slope, guessed_slope = self._seen
        spread = max(value.std().item(), torch.finfo(value.dtype).tiny)
        cosine = functional.cosine_similarity(slope, guessed_slope, dim=1).mean()
        return {
            "forecast/distil_error": error.square().mean().sqrt().item() / spread,
            "forecast/distil_slope": cosine.item(),
        }
