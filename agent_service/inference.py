"""Policies as the agent runs them: numpy, one observation at a time, no allocation per action.

Numpy with preallocated buffers took 42 us at a paced 1 kHz for 17-256-256-12, against 118-150 us
for eager PyTorch and 23-37 us for ONNX Runtime, whose weight swap costs 500 us; so the acting
process loads no PyTorch.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtcore.messages import Architecture

Array = NDArray[np.float32]

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0  # as the learner clamps it
NOISE_ROWS = 64  # one draw takes 4 us, 64 at once 6

# Arrays, as converting a Python number costs 1 us a call.
_ZERO = np.zeros((), np.float32)
_LEAST, _MOST = np.full((), LOG_STD_MIN, np.float32), np.full((), LOG_STD_MAX, np.float32)


class ActingPolicy(Protocol):
    """Maps an observation to an action in the environment's units."""

    version: int

    def act(self, observation: Array, rng: np.random.Generator) -> Array:
        """Sample an action, float32 [action_dim]. The array is reused by the next call."""


class UniformPolicy:
    """pi_0: uniformly random over the action space, whatever is observed."""

    version = 0

    def __init__(self, low: Array, high: Array) -> None:
        self._low = low
        self._span = high - low
        self._action = np.empty_like(low)

    def act(self, observation: Array, rng: np.random.Generator) -> Array:
        """Sample an action, float32 [action_dim]."""
        del observation
        rng.random(dtype=np.float32, out=self._action)
        self._action *= self._span
        self._action += self._low
        return self._action


class TanhGaussianPolicy:
    """tanh(mean + std * noise) of a ReLU MLP, scaled to [low, high].

    Few calls, as each costs 1 to 3 us between two ticks, more than its arithmetic: biases are a last column
    of the weights, against a last entry of 1 in the layer's input, and noise is drawn for many actions.
    """

    def __init__(
        self, version: int, architecture: Architecture, weights: dict[str, Array], low: Array, high: Array
    ) -> None:
        """`weights` as `rtcore.weights.verify` returns them; low and high are float32 [action_dim]."""
        self.version = version
        self._input = np.ones(architecture.observation_dim + 1, np.float32)
        self._layers: list[tuple[Array, Array, Array]] = []  # weights with biases, all inputs, own outputs
        inputs = self._input
        for i, width in enumerate(architecture.hidden):
            outputs = np.ones(width + 1, np.float32)
            self._layers.append((_joined(weights, f"trunk.{i}"), inputs, outputs[:-1]))
            inputs = outputs
        self._last = inputs
        self._heads = np.concatenate([_joined(weights, "mean"), _joined(weights, "log_std")])
        dim = architecture.action_dim
        self._both = np.empty(2 * dim, np.float32)
        self._mean, self._log_std = self._both[:dim], self._both[dim:]
        self._noise = np.zeros((NOISE_ROWS, dim), np.float32)
        self._row = NOISE_ROWS
        self._half_span = (high - low) / 2
        self._middle = (high + low) / 2

    def act(self, observation: Array, rng: np.random.Generator) -> Array:
        """Sample an action, float32 [action_dim]."""
        if self._row == NOISE_ROWS:
            rng.standard_normal(dtype=np.float32, out=self._noise)
            self._row = 0
        action: Array = self._noise[self._row]
        self._row += 1
        self._squash(observation, action)
        action *= self._half_span
        action += self._middle
        return action

    def warm_up(self) -> None:
        """Touch all weights and code once, so that the first real action is not the slow one."""
        self._squash(np.zeros(len(self._input) - 1, np.float32), np.zeros(len(self._mean), np.float32))

    def _squash(self, observation: Array, noise: Array) -> None:
        """Turn noise into an action in (-1, 1), in place."""
        self._input[:-1] = observation
        for weights, inputs, outputs in self._layers:
            np.dot(weights, inputs, out=outputs)
            np.maximum(outputs, _ZERO, out=outputs)
        np.dot(self._heads, self._last, out=self._both)
        log_std = self._log_std
        np.maximum(log_std, _LEAST, out=log_std)
        np.minimum(log_std, _MOST, out=log_std)
        np.exp(log_std, out=log_std)
        noise *= log_std
        noise += self._mean
        np.tanh(noise, out=noise)


def _joined(weights: dict[str, Array], layer: str) -> Array:
    """Weights and biases of a layer side by side, [out, in + 1]."""
    return np.concatenate([weights[f"{layer}.weight"], weights[f"{layer}.bias"][:, None]], axis=1)
