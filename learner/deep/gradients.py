"""The networks' forward passes and gradients, written out by hand on memory that is kept.

Half of the time of an update through autograd went into the graph, fresh memory, and gradients that
nobody uses: those of the critics in the policy's step, and of the observation. Here a pass computes what
is asked for and nothing else. With `bfloat16`, products read and write that type and add up in float32;
parameters, their optimisers, the last layer's output and all that follows from it stay float32. A Q of
150 in bfloat16 would be rounded to the next half.

Shapes: n networks side by side, B the batch, A the action's dimension, H a hidden width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from learner.deep.networks import FlatParameters

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0

_LOG_2 = math.log(2.0)
_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)


class Mlp:
    """n perceptrons of one shape side by side, ReLU between the layers, ready for products.

    Attributes:
        weights: [n, in, out] of each layer, in the products' precision.
        biases: [n, 1, out] of each layer, likewise.
        gradients: of weight and bias of each layer, likewise; none where nothing is trained.
        output: weight and bias of the last layer in float32.
    """

    def __init__(self, parameters: FlatParameters, precision: torch.dtype) -> None:
        self._parameters = parameters
        same = precision == torch.float32
        self._working = parameters.flat if same else torch.empty_like(parameters.flat, dtype=precision)
        self._gradient = parameters.grad if same else torch.zeros_like(parameters.grad, dtype=precision)
        views = list(parameters.views(self._working).values())
        self.weights, self.biases = views[0::2], views[1::2]
        self.transposed = [weight.transpose(1, 2) for weight in self.weights]
        trained = len(parameters.grad) > 0
        gradients = list(parameters.views(self._gradient).values()) if trained else []
        self.gradients = list(zip(gradients[0::2], gradients[1::2], strict=True))
        weight, bias = list(parameters.views(parameters.flat).values())[-2:]
        self.output = _column(weight), bias
        self.refresh()

    def refresh(self) -> None:
        """Take the parameters as they are now; call it whenever they have changed."""
        if self._working is not self._parameters.flat:
            self._working.copy_(self._parameters.flat)

    def deliver(self) -> None:
        """Hand the gradients over to the parameters' buffer."""
        if self._gradient is not self._parameters.grad:
            self._parameters.grad.copy_(self._gradient)


class Pass:
    """Room for a batch on its way through an `Mlp`, forth and back. The caller fills `input`.

    Attributes:
        input: [B, in], in the products' precision.
        output: [n, B, out], float32, of the last `forward`.
    """

    def __init__(self, nets: int, rows: int, widths: Sequence[int], precision: torch.dtype) -> None:
        self.input = torch.zeros(rows, widths[0], dtype=precision)
        self._hidden = [torch.zeros(nets, rows, width, dtype=precision) for width in widths[1:-1]]
        self._deltas = [torch.zeros_like(hidden) for hidden in self._hidden]
        last = self._hidden[-1]
        self._last = last if precision == torch.float32 else torch.zeros_like(last, dtype=torch.float32)
        self.output = torch.zeros(nets, rows, widths[-1])
        self._prepare()

    def _prepare(self) -> None:
        """Views that every pass needs."""
        self._inputs = self.input.expand(self._hidden[0].shape[0], *self.input.shape)
        self._below = [self._inputs, *self._hidden]
        self._below_transposed = [below.transpose(1, 2) for below in self._below]
        self._hidden_bits = [_comparable(hidden) for hidden in self._hidden]
        self._delta_bits = [_comparable(delta) for delta in self._deltas]

    def rows(self, start: int, stop: int) -> Pass:
        """Some of the rows of the only network, in the same memory.

        Indexed and not sliced along the networks: with the strides of a slice, products copy first.
        """
        part = object.__new__(Pass)
        part.input = self.input[start:stop]
        part._hidden = [hidden[0, start:stop][None] for hidden in self._hidden]
        part._deltas = [delta[0, start:stop][None] for delta in self._deltas]
        part._last = part._hidden[-1] if self._last is self._hidden[-1] else self._last[0, start:stop][None]
        part.output = self.output[0, start:stop][None]
        part._prepare()
        return part

    def forward(self, net: Mlp) -> Tensor:
        """Values of `input`, [n, B, out]: `output`, which the next call overwrites."""
        for layer, bits in enumerate(self._hidden_bits):
            torch.baddbmm(net.biases[layer], self._below[layer], net.weights[layer], out=self._hidden[layer])
            torch.relu_(bits)
        if self._last is not self._hidden[-1]:
            self._last.copy_(self._hidden[-1])
        weight, bias = net.output
        return torch.bmm(self._last, weight, out=self.output).add_(bias)

    def backward(self, net: Mlp, d_output: Tensor) -> Tensor:
        """Carry d loss / d output, [n, B, out], down to the hidden layers; return it in their precision."""
        delta = above = d_output.to(self.input.dtype)
        for layer in reversed(range(len(self._hidden))):
            torch.bmm(above, net.transposed[layer + 1], out=self._deltas[layer])
            bits = self._delta_bits[layer]
            torch.ops.aten.threshold_backward.grad_input(bits, self._hidden_bits[layer], 0, grad_input=bits)
            above = self._deltas[layer]
        return delta

    def to_parameters(self, net: Mlp, d_output: Tensor) -> None:
        """Gradients of all parameters, into their buffer, given d loss / d output, [n, B, out]."""
        deltas = [*self._deltas, self.backward(net, d_output)]
        for below, delta, (weight, bias) in zip(self._below_transposed, deltas, net.gradients, strict=True):
            torch.bmm(below, delta, out=weight)
            torch.sum(delta, 1, keepdim=True, out=bias)
        net.deliver()

    def to_input(self, net: Mlp, d_output: Tensor, last: int) -> Tensor:
        """Gradient of the `last` columns of the input, [n, B, last], given d loss / d output, [n, B, out]."""
        self.backward(net, d_output)
        return torch.bmm(self._deltas[0], net.transposed[0][:, :, -last:])


class Proposal(NamedTuple):
    """Actions that the policy draws, and what their gradient needs."""

    action: Tensor  # [B, A], in (-1, 1)
    log_prob: Tensor  # [B], nats
    spread: Tensor  # [B, A], std * noise
    free: Tensor  # [B, A], where log std is not clamped


def propose(heads: Tensor, noise: Tensor) -> Proposal:
    """Actions a = tanh(u), u = mean + std * noise, and their log density (Haarnoja et al. 2018, appendix C).

        log pi(a|s) = sum_i [log N(u_i; mean_i, std_i) - log(1 - tanh(u_i)^2)]

    with log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u)), which stays exact where tanh saturates.

    Args:
        heads: [B, 2A], the actor's output: mean, and log std before it is clamped.
        noise: [B, A], standard normal.
    """
    mean, raw = heads.chunk(2, dim=-1)
    log_std = raw.clamp(LOG_STD_MIN, LOG_STD_MAX)
    spread = log_std.exp().mul_(noise)
    u = mean + spread
    log_normal = -0.5 * noise.square() - log_std - _HALF_LOG_2_PI
    log_slope = 2.0 * (_LOG_2 - u - functional.softplus(-2.0 * u))
    free = (log_std == raw).to(raw.dtype)
    return Proposal(torch.tanh(u), (log_normal - log_slope).sum(-1), spread, free)


def policy_loss_to_heads(proposal: Proposal, q_to_action: Tensor, alpha: float) -> Tensor:
    """Gradient of mean(alpha log pi(a|s) - Q(s, a)) in the actor's output, [B, 2A].

    With d log pi / du = 2 tanh(u) from the slope of tanh (the Gaussian's part does not depend on u,
    given the noise), dL/du = (2 alpha a - (1 - a^2) dQ/da) / B; the mean gets dL/du, log std
    dL/du * std * noise - alpha / B.

    Args:
        proposal: a and what led to it.
        q_to_action: dQ/da, [B, A].
        alpha: temperature.
    """
    action = proposal.action
    d_u = (2.0 * alpha * action - (1.0 - action.square()) * q_to_action) / len(action)
    d_log_std = (d_u * proposal.spread - alpha / len(action)) * proposal.free
    return torch.cat((d_u, d_log_std), dim=-1)


def smaller(q: Tensor) -> Tensor:
    """The smaller of both critics' values, [B], from [2, B, 1]."""
    return torch.minimum(q[0, :, 0], q[1, :, 0])


def climb(room: Pass, critics: Mlp, action_dim: int) -> tuple[Tensor, Tensor]:
    """min(Q1, Q2) at the inputs in `room`, [B], and its gradient in the action, [B, A]."""
    q = room.forward(critics)
    first = (q[0] <= q[1]).float()
    gradients = room.to_input(critics, torch.stack((first, 1.0 - first)), action_dim)
    return smaller(q), gradients.sum(0, dtype=torch.float32)


def critic_loss_to_output(q: Tensor, target: Tensor) -> Tensor:
    """Gradient of 1/2 sum_i mean (Q_i - y)^2 in the critics' output: [2, B, 1] from q likewise and y, [B]."""
    return (q - target[:, None]) / len(target)


def _column(weight: Tensor) -> Tensor:
    """The same weights [n, in, out], with the strides of a transposed row if there is one output.

    The product of 2 x 256 x 256 with the other strides took 105 us, with these 11 us.
    """
    nets, width, out = weight.shape
    return weight.view(nets, 1, width).transpose(1, 2) if out == 1 else weight


def _comparable(values: Tensor) -> Tensor:
    """The same memory, as a type in which comparing with zero is fast and agrees.

    The bits of a bfloat16, taken as int16, have the same sign: ReLU on 2 x 256 x 256 took 3 us that way
    and 19 us on bfloat16, its gradient 9 us and 22 us.
    """
    return values.view(torch.int16) if values.dtype == torch.bfloat16 else values
