"""The networks and the policy's density as their formulas read, for autograd to differentiate."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from learner.deep.networks import FlatParameters


def mlp(parameters: Mapping[str, Tensor], inputs: Tensor) -> Tensor:
    """Values [n, B, out] of n perceptrons side by side at `inputs`, [B, in]."""
    hidden, layers = inputs, len(parameters) // 2
    for layer in range(layers):
        hidden = hidden @ parameters[f"{layer}.weight"] + parameters[f"{layer}.bias"]
        if layer < layers - 1:
            hidden = hidden.clamp(min=0)
    return hidden


def squashed_gaussian(heads: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """tanh of a Gaussian [B, A], and its log density [B]; heads are [B, 2A]."""
    mean, raw = heads.chunk(2, dim=-1)
    std = raw.clamp(-20, 2).exp()
    u = mean + std * noise
    density = torch.exp(-((u - mean) ** 2) / (2 * std**2)) / (std * (2 * torch.pi) ** 0.5)
    return torch.tanh(u), (torch.log(density) - torch.log(1 - torch.tanh(u) ** 2)).sum(-1)


def critic_value(critic: FlatParameters, observation: Tensor, action: Tensor) -> Tensor:
    """min(Q1, Q2), [B]."""
    both = mlp(critic.views(critic.flat), torch.cat((observation, action), -1))[..., 0]
    return both.min(0).values
