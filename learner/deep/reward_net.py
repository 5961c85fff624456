"""A learned family of rewards: one network f(s', a, z), and one latent z per unit, learned together.

Nothing is known of the reward but that one number per unit tells its units apart. Loss over a batch, of
which one half is drawn from all units and the other from the last 3:

    mean_i (f(s'_i, a_i, z_u(i)) - r_i)^2 + 1e-3 z_u(i)^2

A unit's latent begins where the one before is. Because the steps of Adam are too few to bring a new
unit's latent home, it is also fitted by itself, with f as it is, to least squared error plus

    1e-3 z^2 + 1e-2 (z - z of the unit before)^2

The last term keeps z on its side where two of them pay the same. Without it a network that was folded
over z = 0 earned -0.27 per tick on one seed of ten (fast sine), where it has earned -0.10 since: the
series of z jumped between both sides, and nothing forecasts that. A switch of the reward costs more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.checkpoint import State
from learner.deep.gradients import Mlp, Pass
from learner.deep.networks import Adam, FlatParameters, make_networks
from learner.deep.reward_families import Latents, Wide
from learner.forecast.scalar import Series
from learner.replay import Batch, Columns, Floats, Replay, make_batch
from rtcore.config import RewardModelConfig

STEPS = 4  # of Adam per look at new transitions; looks come about four times a unit

_RECENT_UNITS = 3
_PRIOR = 1e-3
_NEARNESS = 1e-2
_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-8  # Adam's usual ones
_MOST_FITTED = 128  # transitions that a latent is fitted to, evenly spaced over its unit
_GRID = 33
_MARGIN = 0.5  # how far beyond the latents so far a new one is sought, at least


@dataclass(frozen=True, slots=True)
class UnitBatch(Batch):
    """A batch that also knows the unit of each transition."""

    unit: NDArray[np.int32]  # [B]


def _make_unit_batch(rows: int, observation_dim: int, action_dim: int) -> UnitBatch:
    plain = make_batch(rows, observation_dim, action_dim)
    return UnitBatch(
        plain.observation,
        plain.action,
        plain.reward,
        plain.next_observation,
        plain.terminated,
        np.zeros(rows, np.int32),
    )


class Learned:
    """The reward network and the units' latents. See the module, and `RewardModel`."""

    def __init__(
        self, config: RewardModelConfig, replay: Replay, batch: int, rng: np.random.Generator
    ) -> None:
        """`batch`: transitions per step and per call of `rewards`; `rng`: for the network and its batches."""
        self.residual = 0.0
        self._replay, self._rng, self._latent_lr = replay, rng, config.latent_lr
        width = replay.observation_dim + replay.action_dim + 1
        widths = [width, *config.hidden, 1]
        self._parameters = make_networks(1, widths, rng)
        self._adam = Adam(self._parameters.flat, self._parameters.grad, config.lr)
        self._net = Mlp(self._parameters, torch.float32)
        self._relabelling = Pass(1, batch, widths, torch.float32)
        self._learning = Pass(1, 2 * math.ceil(batch / 2), widths, torch.float32)
        dims = (replay.observation_dim, replay.action_dim)
        self._halves = [_make_unit_batch(math.ceil(batch / 2), *dims) for _ in range(2)]
        self._latents = Latents()
        self._moments: Wide = np.zeros((2, 0))  # Adam's of the latents
        self._steps = 0

    def begin(self, unit: int) -> None:
        """See `RewardModel`. Latents of units that the replay has forgotten are forgotten too."""
        added = self._latents.begin(unit)
        oldest = int(self._replay.read(0, 1).unit[0])
        dropped = self._latents.forget(oldest)
        self._moments = np.concatenate([self._moments, np.zeros((2, added))], axis=1)[:, dropped:]

    def learn(self) -> None:
        """Some steps of Adam on the network and the latents."""
        for _ in range(STEPS):
            self._step()

    def _step(self) -> None:
        everything, recent = self._halves
        newest = self._latents.newest
        self._replay.sample(self._rng, everything, self._latents.first)
        self._replay.sample(self._rng, recent, newest + 1 - _RECENT_UNITS)
        index = np.concatenate([everything.unit, recent.unit]) - self._latents.first
        begun = index < len(self._latents.values)  # not so after a pause, as long as units are looked at
        index[~begun] = 0
        rows, half = len(index), len(everything.reward)
        latent = self._latents.values[index]
        _enter(self._learning.input[:half], everything, latent[:half])
        _enter(self._learning.input[half:], recent, latent[half:])
        reward = torch.from_numpy(np.concatenate([everything.reward, recent.reward]))
        error = (self._learning.forward(self._net)[0, :, 0] - reward).mul_(torch.from_numpy(begun))
        d_output = (2.0 / rows * error)[None, :, None]
        self._learning.to_parameters(self._net, d_output)
        d_latent = self._learning.to_input(self._net, d_output, 1)[0, :, 0].numpy()
        self._adam.step()
        self._net.refresh()
        per_row = begun * (d_latent + 2.0 * _PRIOR / rows * latent)
        gradient = np.bincount(index, per_row, len(self._latents.values)).astype(np.float64)
        self._move_latents(gradient)

    def _move_latents(self, gradient: Wide) -> None:
        """A step of Adam; those without a gradient go on by their momentum."""
        self._steps += 1
        first, second = self._moments
        first += (1.0 - _BETA1) * (gradient - first)
        second += (1.0 - _BETA2) * (gradient**2 - second)
        root = np.sqrt(second / (1.0 - _BETA2**self._steps)) + _EPS
        self._latents.values -= self._latent_lr * first / (1.0 - _BETA1**self._steps) / root

    def fit(self, seen: Columns) -> None:
        """The newest unit's latent by itself: a grid, a finer one around its best point, a parabola."""
        chosen = np.linspace(0, len(seen.reward) - 1, min(len(seen.reward), _MOST_FITTED)).astype(np.int64)
        reward = torch.from_numpy(seen.reward[chosen])
        # in PyTorch's own memory, where products do not depend on the address
        inputs = torch.tensor(np.hstack([seen.next_observation[chosen], seen.action[chosen]]))
        known = self._latents.series(self._latents.newest)
        low, high = float(known.min()), float(known.max())
        margin = max(_MARGIN, (high - low) / 2)
        coarse = np.linspace(low - margin, high + margin, _GRID)
        before = known[-2] if len(known) > 1 else 0.0
        best = int(np.argmin(self._errors(inputs, reward, coarse) + _reluctance(coarse, before)))
        fine = np.linspace(coarse[max(best - 1, 0)], coarse[min(best + 1, _GRID - 1)], _GRID)
        errors = self._errors(inputs, reward, fine)
        losses = errors + _reluctance(fine, before)
        best = int(np.argmin(losses))
        self._latents.values[-1] = _vertex(fine, losses, best)
        self._moments[:, -1] = 0.0
        self.residual = math.sqrt(errors[best])

    def _errors(self, inputs: Tensor, reward: Tensor, latents: Wide) -> Wide:
        """Mean square error over transitions of one unit, [n, in - 1], under each of G latents: [G]."""
        weights, biases = self._net.weights, self._net.biases
        known = inputs @ weights[0][0, :-1] + biases[0][0]  # the same for every latent
        latent = torch.from_numpy(latents.astype(np.float32))
        hidden = (known[None] + latent[:, None, None] * weights[0][0, -1]).relu_()
        for weight, bias in zip(weights[1:-1], biases[1:-1], strict=True):
            hidden = (hidden @ weight[0] + bias[0]).relu_()
        error = (hidden @ weights[-1][0] + biases[-1][0])[..., 0] - reward
        return error.square().mean(1).numpy().astype(np.float64)

    def series(self, unit: int) -> Series:
        """See `RewardModel`."""
        return self._latents.series(unit)

    def rewards(self, batch: Batch, latent: float) -> Floats:
        """See `RewardModel`."""
        _enter(self._relabelling.input, batch, np.float64(latent))
        paid: Floats = self._relabelling.forward(self._net)[0, :, 0].numpy()
        return paid

    def trained(self) -> dict[str, tuple[FlatParameters, Adam]]:
        """See `RewardModel`."""
        return {"reward": (self._parameters, self._adam)}

    def state(self) -> State:
        """See `RewardModel`."""
        latents = self._latents
        scalars = {
            "first": latents.first,
            "count": len(latents.values),
            "residual": self.residual,
            "steps": self._steps,
        }
        return State({"latents": latents.values.copy(), "moments": self._moments.copy()}, scalars)

    def expected(self, scalars: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """See `RewardModel`."""
        count = scalars["count"]
        return {"latents": np.zeros(count), "moments": np.zeros((2, count))}

    def load(self, state: State) -> None:
        """See `RewardModel`."""
        self._latents.first = int(state.scalars["first"])
        self._latents.values = state.tensors["latents"].copy()
        self._moments = state.tensors["moments"].copy()
        self._steps = int(state.scalars["steps"])
        self.residual = float(state.scalars["residual"])
        self._net.refresh()


def _enter(inputs: Tensor, batch: Batch, latent: Wide | np.float64) -> None:
    """Write s', a and z into the rows of a pass."""
    rows: Floats = inputs.numpy()
    observation_dim = batch.next_observation.shape[1]
    rows[:, :observation_dim] = batch.next_observation
    rows[:, observation_dim:-1] = batch.action
    rows[:, -1] = latent


def _reluctance(latent: Wide, before: float) -> Wide:
    """What a latent costs besides its errors, [G]: 1e-3 z^2 + 1e-2 (z - z of the unit before)^2."""
    return _PRIOR * latent**2 + _NEARNESS * (latent - before) ** 2


def _vertex(grid: Wide, losses: Wide, best: int) -> float:
    """Of the parabola through the best point and its neighbours; at the grid's ends, the best point."""
    if not 0 < best < len(grid) - 1:
        return float(grid[best])
    left, middle, right = losses[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend > 0 else 0.0
    return float(grid[best] + shift * (grid[1] - grid[0]))
