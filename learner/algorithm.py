"""What the learner's service asks of an algorithm, and which ones there are."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import State
from learner.deep.fsac import Fsac
from learner.deep.sac import Sac
from learner.replay import Replay
from rtcore.config import RunConfig
from rtcore.messages import Architecture
from rtcore.spaces import Spaces
from rtcore.windows import Window


class Algorithm(Protocol):
    """A student: learns from the replay, step by step. One thread owns it and its replay.

    Attributes:
        algo: its name in the configuration and in published policies.
        architecture: of the policy that `policy_arrays` gives.
        gradient_steps: calls of `update` so far, checkpoints included.
        policy_steps: how many of them improved the policy.
    """

    algo: str
    architecture: Architecture
    gradient_steps: int
    policy_steps: int

    def update(self, *, improve_policy: bool) -> None:
        """One gradient step on one batch: critics and targets, and with `improve_policy` the policy.

        Raises:
            ValueError: the replay holds no transition.
        """

    def iterate(self, g: int) -> bool:
        """Iterate g of the window is about to be published, or its time is over: bring the policy there,
        if it is improved unit by unit and not by `update`. Asked again, it does nothing.

        Returns:
            Whether the policy changed.
        """

    def begin_window(self, window: Window, unit: int) -> None:
        """Window m was entered in `unit`, which is t_m unless the learner came late."""

    def end_unit(self, unit: int) -> None:
        """Unit t ended. In the last unit of a window, call this before the next `begin_window`."""

    def policy_arrays(self) -> dict[str, NDArray[np.float32]]:
        """Float32 copies of the policy's parameters, under the names of `rtcore.weights`."""

    def metrics(self) -> dict[str, float]:
        """What the newest update saw. Fetches numbers from tensors, so ask at a display's rate."""

    def state(self) -> State:
        """Everything needed to go on bit for bit, as copies; the replay is not in it."""

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """


def make_algorithm(run: RunConfig, spaces: Spaces, seed: int, replay: Replay) -> Algorithm:
    """The algorithm that `run.learner.algo` names, with fresh networks or tables.

    Raises:
        ConfigError: it does not fit the world's spaces.
    """
    config = run.learner
    if config.algo == "fsac":
        return Fsac(config, spaces.observation_dim, spaces.action_dim, seed, replay)
    return Sac(config, spaces.observation_dim, spaces.action_dim, seed, replay)
