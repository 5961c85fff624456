"""Qtilde of one window: past critics, weighted (paper, section "Future Q value estimator")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from learner.deep.critic_history import Snapshot
from learner.deep.gradients import Pass, climb, smaller
from rtcore.windows import Window


@dataclass(frozen=True, slots=True)
class Forecast:
    """Qtilde = sum_k w_k min(Q1_k, Q2_k).

    Sums over the snapshots run in float64: weights of both signs whose norm is far above 1 cancel.

    Attributes:
        window: whose t_m the forecast was made at.
        horizon: h in units; the forecast is of Q at t_m + h.
        weights: w_k, one per snapshot.
        judged_weights: of the same fit read at t_{m+1}, where it is compared with what came.
        snapshots: the past critics, oldest first.
        before: the critics at t_m.
    """

    window: Window
    horizon: float
    weights: tuple[float, ...]
    judged_weights: tuple[float, ...]
    snapshots: tuple[Snapshot, ...]
    before: Snapshot

    def value(self, room: Pass, weights: Sequence[float]) -> Tensor:
        """The sum so weighted at the inputs in `room`, [B], float64."""
        total = torch.zeros(len(room.input), dtype=torch.float64)
        for weight, snapshot in zip(weights, self.snapshots, strict=True):
            total.add_(smaller(room.forward(snapshot.net)), alpha=weight)
        return total

    def climb(self, room: Pass, action_dim: int) -> tuple[Tensor, Tensor]:
        """Qtilde at the inputs in `room`, [B], and its gradient in the action, [B, A].

        A plain loop: evaluating all snapshots in one batched product took 1.6 to 1.9 times as long
        on a CPU (l_p = 5 to 20, B = H = 256).
        """
        rows = len(room.input)
        total = torch.zeros(rows, dtype=torch.float64)
        gradient = torch.zeros(rows, action_dim, dtype=torch.float64)
        for weight, snapshot in zip(self.weights, self.snapshots, strict=True):
            value, slope = climb(room, snapshot.net, action_dim)
            total.add_(value, alpha=weight)
            gradient.add_(slope, alpha=weight)
        return total.float(), gradient.float()
