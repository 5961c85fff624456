"""Forecasting soft actor-critic (paper, Algorithm 2): SAC whose policy climbs a forecast Q.

At the start t_m of a window, ForQ combines frozen copies of past critics into
Qtilde = sum_k w_k min(Q1_k, Q2_k), the Q function expected `horizon` units after t_m. It replaces
the live critics in the policy's loss alone, and stays the same until the next window. Critics and
targets learn as in SAC. The paper prints SAC with a separate V network; this is the form with
target critics instead.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.checkpoint import State
from learner.deep.critic_history import CriticHistory, Snapshot
from learner.deep.distil import Distilled
from learner.deep.gradients import Pass, climb, smaller
from learner.deep.networks import Adam, FlatParameters
from learner.deep.sac import Sac
from learner.forecast.forq import forq_weights
from learner.replay import Replay
from rtcore.config import LearnerConfig
from rtcore.windows import Window


@dataclass(frozen=True, slots=True)
class Forecast:
    """Qtilde of one window.

    Attributes:
        window: whose t_m the forecast was made at.
        horizon: h in units; the forecast is of Q at t_m + h.
        weights: w_k, one per snapshot.
        snapshots: the past critics, oldest first.
    """

    window: Window
    horizon: float
    weights: tuple[float, ...]
    snapshots: tuple[Snapshot, ...]

    def value(self, room: Pass) -> Tensor:
        """Qtilde at the inputs in `room`, [B]."""
        total = torch.zeros(len(room.input))
        for weight, snapshot in zip(self.weights, self.snapshots, strict=True):
            total.add_(smaller(room.forward(snapshot.net)), alpha=weight)
        return total

    def climb(self, room: Pass, action_dim: int) -> tuple[Tensor, Tensor]:
        """Qtilde at the inputs in `room`, [B], and its gradient in the action, [B, A].

        A plain loop: evaluating all snapshots in one batched product took 1.6 to 1.9 times as long
        on a CPU (l_p = 5 to 20, B = H = 256).
        """
        total, gradient = torch.zeros(len(room.input)), torch.zeros(len(room.input), action_dim)
        for weight, snapshot in zip(self.weights, self.snapshots, strict=True):
            value, slope = climb(room, snapshot.net, action_dim)
            total.add_(value, alpha=weight)
            gradient.add_(slope, alpha=weight)
        return total, gradient


@dataclass(slots=True)
class Judgement:
    """How forecasts made at t_m compared with the critics reached at t_{m+1}, over the windows so far.

    Errors are root mean squares over a batch of remembered (s, a), in units of Q.
    """

    windows: int = 0
    error_sum: float = 0.0
    baseline_error_sum: float = 0.0  # of the newest critic known at t_m, taken as it was


class Fsac(Sac):
    """The FSAC learner. Until its first forecast, or without one, it is SAC bit for bit."""

    algo = "fsac"

    def __init__(
        self, config: LearnerConfig, observation_dim: int, action_dim: int, seed: int, replay: Replay
    ) -> None:
        super().__init__(config, observation_dim, action_dim, seed, replay)
        self._history = CriticHistory(config.forecast.l_p, self._precision)
        self._forecast: Forecast | None = None
        self._judgement = Judgement()

    def _build_passes(self) -> None:
        super()._build_passes()
        shape = self.architecture
        widths = [shape.observation_dim + shape.action_dim, *shape.hidden, 1]
        distil = self._config.forecast.distil
        self._distilled = Distilled(widths, self._config.batch, self._precision) if distil else None

    def end_unit(self, unit: int) -> None:
        """Unit t ended: keep a copy of the critics. Critics that have not learnt yet are not kept."""
        if self._config.forecast.kind != "none" and self.gradient_steps > 0:
            self._history.push(unit + 1, self._critic)

    def begin_window(self, window: Window, unit: int) -> None:
        """Window m was entered in `unit`: judge the last forecast, then make this window's.

        Call it after `end_unit(t_m - 1)`. When called again in the same window, the forecast made
        first stays. With fewer than l_p snapshots it uses those there are; with none the policy
        goes on against the live critics.
        """
        previous, config = self._forecast, self._config.forecast
        if previous is not None and (previous.window.m, previous.window.start) == (window.m, window.start):
            return
        if previous is not None and previous.window.end == window.start == unit and len(self._replay):
            self._judge(previous)
        self._forecast = None
        snapshots = self._history.snapshots
        if config.kind == "none" or not snapshots:
            return
        # a window without an end has only its update phase for a length
        length = float(window.update if window.hold is None else window.update + window.hold)
        horizon = config.horizon if isinstance(config.horizon, float | int) else length
        times = [snapshot.time - window.start for snapshot in snapshots]
        weights = forq_weights(times, horizon, basis=config.basis, shrink=config.shrink)
        self._forecast = forecast = Forecast(window, horizon, tuple(weights.tolist()), snapshots)
        if self._distilled is not None:
            critics = [snapshot.parameters for snapshot in snapshots]
            self._distilled.restart(forecast.weights, critics)

    def _judge(self, forecast: Forecast) -> None:
        self._draw_batch("judge")
        room = self._values
        reached = smaller(self._evaluate(self._critic_net, self._sampled.observation, self._sampled.action))
        before = smaller(room.forward(forecast.snapshots[-1].net))
        error = (forecast.value(room) - reached).square().mean().sqrt().item()
        baseline = (before - reached).square().mean().sqrt().item()
        self._judgement.windows += 1
        self._judgement.error_sum += error
        self._judgement.baseline_error_sum += baseline

    def _climb(self) -> tuple[Tensor, Tensor]:
        if self._forecast is None or self._config.forecast.trust == "never":
            return super()._climb()
        inputs, action_dim, distilled = self._values.input, self.architecture.action_dim, self._distilled
        if distilled is None:
            return self._forecast.climb(self._values, action_dim)
        exact = distilled.due()
        distilled.steps += 1
        if not exact:
            return distilled.climb(inputs, action_dim)
        value, slope = self._forecast.climb(self._values, action_dim)
        distilled.fit(inputs, value, slope)
        return value, slope

    def metrics(self) -> dict[str, float]:
        """Those of SAC, and of the forecast.

        forecast/snapshots: critics in the forecast now, 0 without one; forecast/weight_norm: its
        ||w||_2, by which noise in past critics is amplified; forecast/horizon: h in units;
        forecast/windows: forecasts judged so far; forecast/error and forecast/baseline_error: means
        over them, see `Judgement`; forecast/distil_error: root mean square of the distilled forecast
        minus the exact sum, in standard deviations of the sum, at the policy's actions in the newest
        batch, before it learns from them; forecast/distil_slope: mean cosine of their slopes in the
        action there.
        """
        found, forecast, judged = super().metrics(), self._forecast, self._judgement
        found["forecast/snapshots"] = float(len(forecast.snapshots)) if forecast else 0.0
        if forecast:
            found["forecast/weight_norm"] = float(np.linalg.norm(forecast.weights))
            found["forecast/horizon"] = forecast.horizon
        found["forecast/windows"] = float(judged.windows)
        if judged.windows:
            found["forecast/error"] = judged.error_sum / judged.windows
            found["forecast/baseline_error"] = judged.baseline_error_sum / judged.windows
        if forecast and self._distilled is not None:
            found |= self._distilled.judged()
        return found

    # -- durability

    def state(self) -> State:
        """That of SAC, with the past critics and the forecast."""
        base, forecast = super().state(), self._forecast
        scalars = base.scalars | {
            "history": [snapshot.time for snapshot in self._history.snapshots],
            "judgement": asdict(self._judgement),
            "forecast": None,
            "distilled_steps": self._distilled.steps if self._distilled is not None else None,
        }
        snapshots = {snapshot.time: snapshot for snapshot in self._history.snapshots}
        tensors = dict(base.tensors)
        if forecast is not None:
            snapshots |= {snapshot.time: snapshot for snapshot in forecast.snapshots}
            scalars["forecast"] = {
                "window": asdict(forecast.window),
                "horizon": forecast.horizon,
                "weights": list(forecast.weights),
                "history": [snapshot.time for snapshot in forecast.snapshots],
            }
        for time, snapshot in snapshots.items():
            for name, value in snapshot.parameters.views(snapshot.parameters.flat).items():
                tensors[_tensor_name(time, name)] = value.numpy().copy()
        return State(tensors, scalars)

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        super().load(state)
        saved = state.scalars["forecast"]
        kept = {time: self._saved_snapshot(state, time) for time in _times(state)}
        self._history.restore(tuple(kept[time] for time in state.scalars["history"]))
        self._judgement = Judgement(**state.scalars["judgement"])
        if self._distilled is not None:
            self._distilled.steps = int(state.scalars["distilled_steps"])
            self._distilled.refresh()
        self._forecast = None
        if saved is not None:
            self._forecast = Forecast(
                window=Window(**saved["window"]),
                horizon=float(saved["horizon"]),
                weights=tuple(saved["weights"]),
                snapshots=tuple(kept[time] for time in saved["history"]),
            )

    def _expected_tensors(self, state: State) -> dict[str, NDArray[Any]]:
        expected = super()._expected_tensors(state)
        for time in _times(state):
            for name, value in self._critic.views(self._critic.flat).items():
                expected[_tensor_name(time, name)] = value.numpy()
        return expected

    def _trained(self) -> dict[str, tuple[FlatParameters, Adam]]:
        found = super()._trained()
        if self._distilled is not None:
            found["distilled"] = self._distilled.parameters, self._distilled.adam
        return found

    def _saved_snapshot(self, state: State, time: int) -> Snapshot:
        parameters = self._critic.frozen_copy()
        for name, view in parameters.views(parameters.flat).items():
            view.copy_(torch.from_numpy(state.tensors[_tensor_name(time, name)].copy()))
        return Snapshot(time, parameters, self._precision)


def _tensor_name(time: int, name: str) -> str:
    return f"history.{time}.{name}"


def _times(state: State) -> list[int]:
    """Of every snapshot in `state`: in the history, in the forecast, or in both."""
    forecast = state.scalars.get("forecast") or {"history": []}
    return sorted({*state.scalars.get("history", []), *forecast["history"]})
