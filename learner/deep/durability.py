"""A deep learner's state, for checkpoints: networks, optimisers, random numbers and counters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.checkpoint import State, require_fit
from learner.deep.networks import Adam, FlatParameters
from rtcore.messages import Architecture

_SAME = ("algo", "observation_dim", "action_dim", "hidden")  # what a checkpoint must agree on


class Durable(ABC):
    """Gives its state and goes on from one. Whoever derives from it says which networks there are."""

    algo: str
    architecture: Architecture
    gradient_steps: int
    policy_steps: int
    _rng: dict[str, np.random.Generator]

    @abstractmethod
    def _trained(self) -> dict[str, tuple[FlatParameters, Adam]]:
        """Networks with the optimiser of each, by name."""

    @abstractmethod
    def _followers(self) -> dict[str, FlatParameters]:
        """Networks that only follow others, by name."""

    @abstractmethod
    def _reloaded(self) -> None:
        """The parameters are others now: forget what was derived from the old ones."""

    def state(self) -> State:
        """Everything needed to go on bit for bit, as copies; the replay is not in it."""
        tensors = {name: view.numpy().copy() for name, view in self._views().items()}
        scalars: dict[str, Any] = {
            "algo": self.algo,
            "observation_dim": self.architecture.observation_dim,
            "action_dim": self.architecture.action_dim,
            "hidden": list(self.architecture.hidden),
            "gradient_steps": self.gradient_steps,
            "policy_steps": self.policy_steps,
            "rng": {name: rng.bit_generator.state for name, rng in self._rng.items()},
        }
        return State(tensors, scalars)

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        require_fit(state, State(self._expected_tensors(state), self.state().scalars), same=_SAME)
        for name, view in self._views().items():
            view.copy_(torch.from_numpy(state.tensors[name].copy()))
        for name, rng in self._rng.items():
            rng.bit_generator.state = state.scalars["rng"][name]
        self.gradient_steps = int(state.scalars["gradient_steps"])
        self.policy_steps = int(state.scalars["policy_steps"])
        self._reloaded()

    def _expected_tensors(self, state: State) -> dict[str, NDArray[Any]]:  # noqa: ARG002 (for subclasses)
        """The tensors that `state`, going by its scalars, should have."""
        return {name: view.numpy() for name, view in self._views().items()}

    def _views(self) -> dict[str, Tensor]:
        """The tensors that a checkpoint keeps, by name: views, so that `load` writes through them."""
        return named_views(self._trained(), self._followers())


def named_views(
    trained: Mapping[str, tuple[FlatParameters, Adam]], followers: Mapping[str, FlatParameters]
) -> dict[str, Tensor]:
    """Parameters and their optimisers' state, as views by name.

    Args:
        trained: by name, with the optimiser of each.
        followers: by name: those that only follow others.
    """
    found = {
        f"{name}.{n}": view for name, one in followers.items() for n, view in one.views(one.flat).items()
    }
    for name, (parameters, optimiser) in trained.items():
        buffers = {"": parameters.flat, "adam.m.": optimiser.moment1, "adam.v.": optimiser.moment2}
        for kind, buffer in buffers.items():
            found |= {f"{name}.{kind}{n}": view for n, view in parameters.views(buffer).items()}
        found[f"{name}.adam.steps"] = optimiser.steps
    return found
