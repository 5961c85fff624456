"""The actor and the twin critics, as functions of flat parameter buffers.

Each network's parameters lie in one contiguous float32 buffer, so that an optimiser step, a
soft target update and a frozen copy are one operation each. Shapes in here: B is the batch,
O and A the observation's and the action's dimension, H a hidden width.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from torch.optim.adam import adam

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0

_LOG_2 = math.log(2.0)
_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
_ALIGN = 16  # floats: every view starts on 64 bytes, where BLAS results do not depend on the address

Shapes = Mapping[str, tuple[int, ...]]


class FlatParameters:
    """Named float32 parameters, all views of one buffer.

    Attributes:
        flat: [n], the values, with zeros between the views.
        grad: [n], where backward passes through `leaves` add their gradients.
        leaves: the parameters in order, for autograd.
        frozen: the same memory, without gradients: a backward pass through them stops there.
    """

    def __init__(self, shapes: Shapes) -> None:
        self._shapes = dict(shapes)
        size = sum(_padded(math.prod(shape)) for shape in self._shapes.values())
        self.flat = torch.zeros(size)
        self.grad = torch.zeros(size)
        self.frozen = tuple(self.views(self.flat).values())
        self.leaves = tuple(view.detach().requires_grad_() for view in self.frozen)
        for leaf, grad in zip(self.leaves, self.views(self.grad).values(), strict=True):
            leaf.grad = grad

    def views(self, buffer: Tensor) -> dict[str, Tensor]:
        """The named parts of `buffer`, which has the layout of `flat`."""
        parts, start = {}, 0
        for name, shape in self._shapes.items():
            length = math.prod(shape)
            parts[name] = buffer[start : start + length].view(shape)
            start += _padded(length)
        return parts

    def initialise(self, rng: np.random.Generator, fan_in: Mapping[str, int]) -> None:
        """Draw each parameter from U(-b, b), b = 1 / sqrt(fan_in): the default of torch's Linear."""
        for name, view in self.views(self.flat).items():
            bound = 1.0 / math.sqrt(fan_in[name])
            values = rng.uniform(-bound, bound, self._shapes[name]).astype(np.float32)
            view.copy_(torch.from_numpy(values))


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


def make_actor(
    observation_dim: int, action_dim: int, hidden: Sequence[int], rng: np.random.Generator
) -> FlatParameters:
    """A ReLU trunk and one last layer that holds both heads: rows [0, A) the mean, [A, 2A) log std.

    Weights are [out, in], as torch's Linear has them.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    fan_in: dict[str, int] = {}
    width = observation_dim
    for index, out in enumerate(hidden):
        shapes |= {f"trunk.{index}.weight": (out, width), f"trunk.{index}.bias": (out,)}
        fan_in |= {f"trunk.{index}.weight": width, f"trunk.{index}.bias": width}
        width = out
    shapes |= {"heads.weight": (2 * action_dim, width), "heads.bias": (2 * action_dim,)}
    fan_in |= {"heads.weight": width, "heads.bias": width}
    actor = FlatParameters(shapes)
    actor.initialise(rng, fan_in)
    return actor


def make_twin_critic(
    observation_dim: int, action_dim: int, hidden: Sequence[int], rng: np.random.Generator | None
) -> FlatParameters:
    """Two critics side by side: weights [2, in, out], biases [2, 1, out]; zeros without `rng`.

    The last layer has one output and is kept as a row, [2, 1, in]: a matrix product with one
    column took 98 us, a product and a sum 17 us (B = H = 256).
    """
    shapes: dict[str, tuple[int, ...]] = {}
    fan_in: dict[str, int] = {}
    width = observation_dim + action_dim
    for index, out in enumerate(hidden):
        shapes |= {f"{index}.weight": (2, width, out), f"{index}.bias": (2, 1, out)}
        fan_in |= {f"{index}.weight": width, f"{index}.bias": width}
        width = out
    last = len(hidden)
    shapes |= {f"{last}.weight": (2, 1, width), f"{last}.bias": (2, 1)}
    fan_in |= {f"{last}.weight": width, f"{last}.bias": width}
    critic = FlatParameters(shapes)
    if rng is not None:
        critic.initialise(rng, fan_in)
    return critic


def policy_heads(parameters: Sequence[Tensor], observation: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and log standard deviation of the Gaussian before tanh, [B, A] each."""
    hidden = observation
    for layer in range(0, len(parameters) - 2, 2):
        hidden = torch.relu_(functional.linear(hidden, parameters[layer], parameters[layer + 1]))
    mean, log_std = functional.linear(hidden, parameters[-2], parameters[-1]).chunk(2, dim=-1)
    return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)


def squashed_gaussian(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """An action a = tanh(u), u = mean + std * noise, and its log density (Haarnoja et al. 2018, appendix C).

        log pi(a|s) = sum_i [log N(u_i; mean_i, std_i) - log(1 - tanh(u_i)^2)]

    with log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u)), which stays exact where tanh saturates.

    Args:
        mean: [B, A], of the Gaussian before tanh.
        log_std: [B, A], log of its standard deviation.
        noise: [B, A], standard normal.

    Returns:
        Action [B, A] in (-1, 1), and log density [B] in nats.
    """
    u = mean + log_std.exp() * noise
    log_normal = -0.5 * noise.square() - log_std - _HALF_LOG_2_PI
    log_slope = 2.0 * (_LOG_2 - u - functional.softplus(-2.0 * u))
    return torch.tanh(u), (log_normal - log_slope).sum(-1)


def twin_q(parameters: Sequence[Tensor], observation: Tensor, action: Tensor) -> Tensor:
    """Both critics' values, [2, B]."""
    joined = torch.cat((observation, action), dim=-1)
    hidden = joined.expand(2, *joined.shape)
    for layer in range(0, len(parameters) - 2, 2):
        hidden = torch.relu_(torch.baddbmm(parameters[layer + 1], hidden, parameters[layer]))
    return (hidden * parameters[-2]).sum(-1) + parameters[-1]


def min_q(parameters: Sequence[Tensor], observation: Tensor, action: Tensor) -> Tensor:
    """The smaller of both critics' values, [B]."""
    first, second = twin_q(parameters, observation, action).unbind(0)
    return torch.minimum(first, second)


def policy_arrays(actor: FlatParameters, action_dim: int) -> dict[str, NDArray[np.float32]]:
    """Float32 copies of the actor's parameters under their published names, heads apart."""
    arrays: dict[str, NDArray[np.float32]] = {}
    for name, view in actor.views(actor.flat).items():
        values = view.numpy().copy()
        if name.startswith("heads."):
            kind = name.removeprefix("heads.")
            arrays[f"mean.{kind}"] = values[:action_dim].copy()
            arrays[f"log_std.{kind}"] = values[action_dim:].copy()
        else:
            arrays[name] = values
    return arrays


def _padded(length: int) -> int:
    return -(-length // _ALIGN) * _ALIGN
