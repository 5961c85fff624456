"""The forecast of a table: past tables, their weighted sum, and what became of it (paper, section 6.1)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import State
from learner.forecast import forq
from learner.forecast.judge import Judge
from learner.tabular.table import Table
from rtcore.config import ForecastConfig
from rtcore.windows import Window

_TABLES = ("judged", "known", "value")


@dataclass(frozen=True, slots=True)
class Forecast:
    """Qtilde of one window, made at t_m. Tables are [S, A] and nothing writes to them again.

    Attributes:
        window: whose t_m it was made at.
        horizon: h in units; it is of Q at t_m + h.
        weights: w_k, one per past table; none: there was nothing to forecast from, and all is Q at t_m.
        judged: the same fit read at t_{m+1}, where it is compared with what came.
        known: Q at t_m, what doing without a forecast would be.
        value: sum_k w_k Q_k.
    """

    window: Window
    horizon: float
    weights: tuple[float, ...]
    judged: Table
    known: Table
    value: Table


class Foreseen(NamedTuple):
    """Past tables, [l, S, A], at times [l] in units relative to t_m; Q in the units t_m .. t_{m+1},
    [W + 1, S, A], and at the horizon of the forecast that the policy will be improved towards, [S, A].
    """

    times: NDArray[np.float64]
    past: Table
    forecasts: Table
    target: Table


class Forecaster:
    """Keeps the newest l_p tables, forecasts at the start of each window and judges at its end."""

    def __init__(self, config: ForecastConfig) -> None:
        self._config = config
        self._judge = Judge(config.trust)
        self._history: dict[int, Table] = {}  # by the unit at whose beginning it was so, oldest first
        self.made: Forecast | None = None

    def keep(self, unit: int, q: Table) -> None:
        """Unit t ended: copy the table, if this is one of the units at which one is kept.

        Tables that are not older are dropped: the unit ended a second time, after a restart that went back.
        """
        time = unit + 1
        if self._config.kind == "none" or time % self._config.every:
            return
        kept = [(earlier, table) for earlier, table in self._history.items() if earlier < time]
        self._history = dict([*kept, (time, q.copy())][-self._config.l_p :])

    def begin(
        self, window: Window, unit: int, q: Table, visited: NDArray[np.bool_], age_units: float
    ) -> Forecast | None:
        """A window was entered in `unit`: judge the last forecast against `q`, then make this window's.

        Args:
            window: the one entered; asked again in the same one, nothing happens and it returns None.
            unit: the present one, t_m unless the learner came late.
            q: [S, A], as it is now.
            visited: [S, A], where to judge: (s, a) that were ever visited.
            age_units: mean age of what `q` was learned from.
        """
        previous = self.made
        if previous is not None and (previous.window.m, previous.window.start) == (window.m, window.start):
            return None
        whole = previous is not None and previous.window.end == window.start == unit
        if previous is not None and previous.weights and whole and visited.any():
            self._judge.hear(_rms(previous.judged - q, visited), _rms(previous.known - q, visited))
        self.made = self._make(window, q, age_units)
        return self.made

    def _make(self, window: Window, q: Table, age_units: float) -> Forecast:
        known = q.copy()
        if not self._history:
            return Forecast(window, 0.0, (), known, known, known)
        times, tables = (
            [time - window.start for time in self._history],
            np.stack(list(self._history.values())),
        )
        ahead, end = forq.horizon(self._config, window, age_units), window.end
        weights = forq.fit(self._config, times, ahead)
        forecast: Table = np.tensordot(weights, tables, 1)
        judged = forecast
        if end is not None and end != window.start + ahead:
            judged = np.tensordot(forq.fit(self._config, times, end - window.start), tables, 1)
        return Forecast(window, ahead, tuple(weights.tolist()), judged, known, forecast)

    def foresee(self, window: Window, plain: Table, age_units: float) -> Foreseen | None:
        """What `trusted` would be with forecasts of every unit of a window that begins now, with `plain` for
        Q at t_m; None without a past table.
        """
        if not self._history:
            return None
        times = [float(time - window.start) for time in self._history]
        past, share = np.stack(list(self._history.values())), self._judge.share
        assert window.end is not None, "a window without end cannot be foreseen"
        ahead = [*range(window.end - window.start + 1), forq.horizon(self._config, window, age_units)]
        weights = np.stack([forq.fit(self._config, times, unit) for unit in ahead])
        tables = share * np.tensordot(weights, past, 1) + (1.0 - share) * plain
        return Foreseen(np.array(times), past, tables[:-1], tables[-1])

    @property
    def alone(self) -> bool:
        """Whether there is a forecast, and it is trusted so far that `trusted` is nothing else."""
        return self.made is not None and bool(self.made.weights) and self._judge.share == 1

    def trusted(self, plain: Table) -> Table:
        """Rho Qtilde + (1 - rho) Q, [S, A], with `plain` for Q and rho the trust that forecasts have earned
        by this window; `plain` itself where there is no forecast, or no trust in it.
        """
        share = self._judge.share
        if self.made is None or not self.made.weights or share == 0:
            return plain
        return share * self.made.value + (1.0 - share) * plain

    def metrics(self) -> dict[str, float]:
        """Those of `Judge`, and of the forecast under way.

        forecast/snapshots: past tables in it; forecast/weight_norm: its ||w||_2, the L of Proposition 1,
        by which noise in past tables is amplified; forecast/horizon: h in units.
        """
        found = self._judge.metrics()
        found["forecast/snapshots"] = float(len(self.made.weights)) if self.made else 0.0
        if self.made and self.made.weights:
            found["forecast/weight_norm"] = float(np.linalg.norm(self.made.weights))
            found["forecast/horizon"] = self.made.horizon
        return found

    # -- durability

    def state(self) -> State:
        """Everything needed to go on, as copies; the names are those of `tensor_names`."""
        scalars: dict[str, Any] = {
            "history": list(self._history),
            "judge": self._judge.state(),
            "forecast": None,
        }
        tensors = {_name(time): table.copy() for time, table in self._history.items()}
        if self.made is not None:
            scalars["forecast"] = {
                "window": asdict(self.made.window),
                "horizon": self.made.horizon,
                "weights": list(self.made.weights),
            }
            tensors |= {f"forecast.{name}": getattr(self.made, name).copy() for name in _TABLES}
        return State(tensors, scalars)

    def load(self, state: State) -> None:
        """Go on from `state`, which was found to fit."""
        times, saved = state.scalars["history"], state.scalars["forecast"]
        kept = {int(time): state.tensors[_name(time)].copy() for time in times}
        self._history = dict(list(kept.items())[-self._config.l_p :])
        self._judge.load(state.scalars["judge"])
        self.made = None
        if saved is not None:
            self.made = Forecast(
                window=Window(**saved["window"]),
                horizon=float(saved["horizon"]),
                weights=tuple(saved["weights"]),
                **{name: state.tensors[f"forecast.{name}"].copy() for name in _TABLES},
            )


def tensor_names(state: State) -> list[str]:
    """Of the tables that `state`, going by its scalars, should hold."""
    names = [_name(time) for time in state.scalars.get("history", [])]
    return names + ([f"forecast.{name}" for name in _TABLES] if state.scalars.get("forecast") else [])


def _name(time: int) -> str:
    return f"history.{time}"


def _rms(error: Table, where: NDArray[np.bool_]) -> float:
    return float(np.sqrt(np.square(error[where]).mean()))
