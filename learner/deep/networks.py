"""Parameters in flat buffers, their optimiser, and the networks that are made of them.

Each network's parameters lie in one contiguous float32 buffer, so that an optimiser step, a
soft target update and a frozen copy are one operation each.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

_ALIGN = 16  # floats: every view starts on 64 bytes, where BLAS results do not depend on the address

Shapes = Mapping[str, tuple[int, ...]]


class FlatParameters:
    """Named float32 parameters, all views of one buffer.

    Attributes:
        flat: [n], the values, with zeros between the views.
        grad: [n], their gradients; [0] where nothing is trained.
    """

    def __init__(self, shapes: Shapes, *, trained: bool = True) -> None:
        self._shapes = dict(shapes)
        size = sum(_padded(math.prod(shape)) for shape in self._shapes.values())
        self.flat = torch.zeros(size)
        self.grad = torch.zeros(size if trained else 0)

    def frozen_copy(self) -> FlatParameters:
        """The values as they are now, in memory of their own, not to be trained."""
        copy = FlatParameters(self._shapes, trained=False)
        copy.flat.copy_(self.flat)
        return copy

    def views(self, buffer: Tensor) -> dict[str, Tensor]:
        """The named parts of `buffer`, which has the layout of `flat`."""
        parts, start = {}, 0
        for name, shape in self._shapes.items():
            length = math.prod(shape)
            parts[name] = buffer[start : start + length].view(shape)
            start += _padded(length)
        return parts


class Adam:
    """Adam over one flat buffer, with torch's fused kernel and default constants.

    Attributes:
        moment1, moment2: [n], running means of the gradient and of its square.
        steps: [], float32, steps taken.
    """

    def __init__(self, parameters: Tensor, grad: Tensor, lr: float) -> None:
        self._parameters, self._grad, self._lr = [parameters], [grad], lr
        self.moment1 = torch.zeros_like(parameters)
        self.moment2 = torch.zeros_like(parameters)
        self.steps = torch.zeros(())

    def step(self) -> None:
        """One descent step along the gradient now in the buffer."""
        adam(
            self._parameters, self._grad, [self.moment1], [self.moment2], [], [self.steps],
            fused=True, amsgrad=False, beta1=0.9, beta2=0.999, lr=self._lr, weight_decay=0.0, eps=1e-8,
            maximize=False,
        )  # fmt: skip


def make_networks(
    nets: int, widths: Sequence[int], rng: np.random.Generator | None, *, trained: bool = True
) -> FlatParameters:
    """`nets` perceptrons of one shape side by side; zeros without `rng`.

    Layer i has `i.weight` [nets, in, out] and `i.bias` [nets, 1, out], both drawn from U(-b, b),
    b = 1 / sqrt(in), as torch's Linear does by default.

    Args:
        nets: how many.
        widths: of the input, the hidden layers and the output.
        rng: where the draw comes from.
        trained: whether to keep room for gradients.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    for index, (width, out) in enumerate(pairwise(widths)):
        shapes |= {f"{index}.weight": (nets, width, out), f"{index}.bias": (nets, 1, out)}
    networks = FlatParameters(shapes, trained=trained)
    if rng is None:
        return networks
    for name, view in networks.views(networks.flat).items():
        bound = 1.0 / math.sqrt(widths[int(name.partition(".")[0])])
        values = rng.uniform(-bound, bound, shapes[name]).astype(np.float32)
        view.copy_(torch.from_numpy(values))
    return networks


def make_actor(
    observation_dim: int, action_dim: int, hidden: Sequence[int], rng: np.random.Generator
) -> FlatParameters:
    """A network whose last layer holds both heads: outputs [0, A) the mean, [A, 2A) log std."""
    return make_networks(1, [observation_dim, *hidden, 2 * action_dim], rng)


def make_twin_critic(
    observation_dim: int, action_dim: int, hidden: Sequence[int], rng: np.random.Generator | None
) -> FlatParameters:
    """Two critics side by side, from observation and action to one value.

    Without `rng` they are zeros and not trained: targets.
    """
    return make_networks(2, [observation_dim + action_dim, *hidden, 1], rng, trained=rng is not None)


def policy_arrays(actor: FlatParameters, action_dim: int) -> dict[str, NDArray[np.float32]]:
    """Float32 copies of the actor's parameters as they are published: [out, in], the heads apart."""
    arrays: dict[str, NDArray[np.float32]] = {}
    views = actor.views(actor.flat)
    last = f"{len(views) // 2 - 1}."
    for name, view in views.items():
        values = view[0].numpy().T if name.endswith("weight") else view[0, 0].numpy()
        if name.startswith(last):
            kind = name.removeprefix(last)
            arrays[f"mean.{kind}"] = values[:action_dim].copy()
            arrays[f"log_std.{kind}"] = values[action_dim:].copy()
        else:
            arrays[f"trunk.{name}"] = values.copy()
    return arrays


def _padded(length: int) -> int:
    return -(-length // _ALIGN) * _ALIGN
