"""Q-learning with the forecast of its future table (paper, sections 6.1 and 6.2)."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from learner.checkpoint import State
from learner.replay import Replay
from learner.tabular.forecast import Forecaster, tensor_names
from learner.tabular.q import QLearning
from learner.tabular.table import Table
from rtcore.config import LearnerConfig
from rtcore.spaces import Spaces
from rtcore.windows import Window


class ForecastingQ(QLearning):
    """Q-learning that keeps past tables and forecasts Q at the start t_m of each window."""

    def __init__(self, config: LearnerConfig, spaces: Spaces, seed: int, replay: Replay) -> None:
        super().__init__(config, spaces, seed, replay)
        self._forecaster = Forecaster(config.forecast)

    def end_unit(self, unit: int) -> None:
        """Unit t ended: keep a copy of the table, unless it has not learned anything yet."""
        if self.gradient_steps > 0:
            self._forecaster.keep(unit, self._q)

    def begin_window(self, window: Window, unit: int) -> None:
        """Window m was entered in `unit`: judge the last forecast, then make this window's.

        Call it after `end_unit(t_m - 1)`. When called again in the same window, the forecast made
        first stays. With fewer than l_p past tables it uses those there are.
        """
        made = self._forecaster.begin(window, unit, self._q, self._visited, self._age_units(unit))
        if made is not None:
            self._forecast_made()

    def _forecast_made(self) -> None:
        """A window began, and `self._forecaster.made` is its forecast."""

    def metrics(self) -> dict[str, float]:
        """Those of `QLearning`, and, where there is a forecast, of `Forecaster`."""
        forecast = {} if self._config.forecast.kind == "none" else self._forecaster.metrics()
        return super().metrics() | forecast

    def state(self) -> State:
        """That of `QLearning`, with the past tables and the forecast."""
        base, forecast = super().state(), self._forecaster.state()
        return State(base.tensors | forecast.tensors, base.scalars | forecast.scalars)

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        super().load(state)
        self._forecaster.load(state)

    def _expected_tensors(self, state: State) -> dict[str, NDArray[Any]]:
        return super()._expected_tensors(state) | dict.fromkeys(tensor_names(state), self._q)


class Fq(ForecastingQ):
    """The policy is epsilon-greedy of the forecast, the same for the whole window.

    As far as the forecast is not trusted, the rest is Q as it is now. So until there is a past table to
    forecast from, with forecast.kind "none" and with no trust at all it is `QLearning`. With
    table.write_back = w the forecast also goes into the table: Q <- (1 - w) Q + w Qtilde, at t_m.

    Attributes:
        policy_steps: policies made from a forecast alone, on top of what `QLearning` counts.
    """

    algo = "fq"

    def _acting(self) -> Table:
        return self._forecaster.trusted(self._q)

    def _follows_q(self) -> bool:
        return not self._forecaster.alone

    def _forecast_made(self) -> None:
        value = self._acting()
        if value is self._q:
            return
        share = self._config.table.write_back
        self._q *= 1.0 - share
        self._q += share * value
        self._changed = True

    def iterate(self, g: int) -> bool:
        """Say whether the policy changed since this was last asked: wholly on a forecast, once a window."""
        changed = super().iterate(g)
        self.policy_steps += changed and self._forecaster.alone
        return changed
