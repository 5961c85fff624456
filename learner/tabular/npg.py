"""Forecasting online reinforcement learning (paper, Algorithm 1): natural policy gradient on a forecast."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import State
from learner.replay import Replay
from learner.tabular.fq import ForecastingQ
from learner.tabular.table import Table, mix, npg_step
from rtcore.config import LearnerConfig
from rtcore.spaces import Spaces


class Npg(ForecastingQ):
    """At t_m the future Q is forecast; each unit of the update phase makes one step towards it.

    The paper's Qhat_t is the table that Q-learning has reached at t. The forecast is the same for all
    steps of a window; without one (forecast.kind "none", or no past table yet) it is Q at t_m. The
    first policy is uniform. What is published has a share table.epsilon of uniformly random actions,
    so that Q goes on hearing of every action; the policy that is improved has not.

    Attributes:
        policy_steps: iterations of the policy so far.
    """

    algo = "npg"

    def __init__(self, config: LearnerConfig, spaces: Spaces, seed: int, replay: Replay) -> None:
        super().__init__(config, spaces, seed, replay)
        self._log_policy: Table = np.full(self._q.shape, -np.log(spaces.actions))
        self._newest = 0  # iterate of this window that was made last

    def update(self, *, improve_policy: bool) -> None:
        """Learn Q from the transitions not read yet; the policy is improved by `iterate` alone."""
        del improve_policy
        super().update(improve_policy=False)

    def _forecast_made(self) -> None:
        self._newest = 0

    def iterate(self, g: int) -> bool:
        """One iteration of the policy, unless this iterate was made before; says whether it was not.

        Units that were not lived in the update phase, because an operator held the policy or the learner
        came late, have no iteration, then or later.
        """
        made = self._forecaster.made
        if made is None or g <= self._newest:
            return False
        self._log_policy[...] = npg_step(
            self._log_policy,
            self._forecaster.trusted(made.known),
            eta=self._config.table.eta,
            entropy=self._config.table.entropy,
            gamma=self._config.gamma,
        )
        self._newest = g
        self.policy_steps += 1
        return True

    def _policy(self) -> Table:
        return mix(np.exp(self._log_policy), self._config.table.epsilon)

    # -- durability

    def state(self) -> State:
        """That of `ForecastingQ`, with how far the window's iterations are."""
        base = super().state()
        return State(base.tensors, base.scalars | {"newest": self._newest})

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        super().load(state)
        self._newest = int(state.scalars["newest"])

    def _tables(self) -> dict[str, NDArray[Any]]:
        return super()._tables() | {"log_policy": self._log_policy}
