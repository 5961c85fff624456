"""Forecasting online reinforcement learning (paper, Algorithm 1): natural policy gradient on a forecast."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import State
from learner.replay import Replay
from learner.schedule.outlook import Outlook
from learner.tabular.fq import ForecastingQ
from learner.tabular.table import Table, mix, npg_step
from rtcore.config import LearnerConfig
from rtcore.spaces import Spaces
from rtcore.windows import Window


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
        self._seen = 0.0  # regret that the tables of this window have shown so far,
        self._looks = 0  # in so many looks: one as it began, and one at the end of each unit
        self._realised = math.nan  # of the window before, whole

    def update(self, *, improve_policy: bool) -> None:
        """Learn Q from the transitions not read yet; the policy is improved by `iterate` alone."""
        del improve_policy
        super().update(improve_policy=False)

    def begin_window(self, window: Window, unit: int) -> None:
        """See `ForecastingQ`."""
        previous = self._forecaster.made
        super().begin_window(window, unit)
        if self._forecaster.made is previous:
            return
        end = None if previous is None else previous.window.end
        whole = previous is not None and end is not None and self._looks == end - previous.window.start + 1
        self._realised = self._seen if whole else math.nan
        self._newest, self._seen, self._looks = 0, self._regret_now(), 1

    def outlook(self, start: int, length: int) -> Outlook | None:
        """The closed form of what `iterate` would make of a window, and the forecasts for its units."""
        window = Window(0, start, length, 0)
        foreseen = self._forecaster.foresee(window, self._q, self._age_units(start))
        if foreseen is None:
            return None
        table = self._config.table
        return Outlook(
            past=foreseen.past,
            times=foreseen.times,
            forecasts=foreseen.forecasts,
            target=foreseen.target,
            log_policy=self._log_policy.copy(),
            rate=min(1.0, table.eta * table.entropy / (1.0 - self._config.gamma)),
            temperature=table.entropy,
        )

    def end_unit(self, unit: int) -> None:
        """Unit t ended: keep a copy of the table, and note what regret it shows for the policy."""
        super().end_unit(unit)
        self._seen += self._regret_now()
        self._looks += 1

    def _regret_now(self) -> float:
        """Mean over the states of max_a Q(s, a) - sum_a pi(a|s) Q(s, a): one unit's share of what the
        schedule `auto` predicts for a window, with the table itself for the forecast of it.
        """
        lost = self._q.max(-1) - (np.exp(self._log_policy) * self._q).sum(-1)
        return float(lost.mean())

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

    def metrics(self) -> dict[str, float]:
        """Those of `ForecastingQ`; schedule/realised: regret of the last window, by the tables that came, in
        the units of what the schedule `auto` predicted for it.
        """
        found = super().metrics()
        return found if math.isnan(self._realised) else found | {"schedule/realised": self._realised}

    def window_start(self) -> tuple[Table, Table] | None:
        """Qtilde as the iterations use it, and log pi as it is now; None before the first window."""
        made = self._forecaster.made
        if made is None:
            return None
        return self._forecaster.trusted(made.known).copy(), self._log_policy.copy()

    def _policy(self) -> Table:
        return mix(np.exp(self._log_policy), self._config.table.epsilon)

    # -- durability

    def state(self) -> State:
        """That of `ForecastingQ`, with how far the window's iterations are."""
        base = super().state()
        realised = None if math.isnan(self._realised) else self._realised
        regret = {"seen": self._seen, "looks": self._looks, "realised": realised}
        return State(base.tensors, base.scalars | {"newest": self._newest} | regret)

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        super().load(state)
        self._newest = int(state.scalars["newest"])
        self._seen, self._looks = float(state.scalars["seen"]), int(state.scalars["looks"])
        realised = state.scalars["realised"]
        self._realised = math.nan if realised is None else float(realised)

    def _tables(self) -> dict[str, NDArray[Any]]:
        return super()._tables() | {"log_policy": self._log_policy}
