"""Forecasting soft actor-critic (paper, Algorithm 2): SAC whose policy climbs a forecast Q.

At the start t_m of a window, ForQ combines past critics into Qtilde = sum_k w_k min(Q1_k, Q2_k), the Q
function expected `horizon` units after t_m. It replaces the live critics in the policy's loss alone, and
stays the same until the next window. Critics and what they bootstrap from learn as in SAC. With
`trust = "judged"` the policy climbs rho Qtilde + (1 - rho) min(Q1, Q2), see `learner.forecast.judge`.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.checkpoint import State
from learner.deep.critic_forecast import Forecast
from learner.deep.critic_history import CriticHistory
from learner.deep.distil import Distilled
from learner.deep.gradients import smaller
from learner.deep.networks import Adam, FlatParameters
from learner.deep.sac import Sac
from learner.forecast.forq import fit, horizon
from learner.forecast.judge import Judge
from learner.replay import Replay
from learner.schedule.outlook import Outlook
from rtcore.config import LearnerConfig
from rtcore.windows import Window

CANDIDATES = 16  # actions in each state that a window's hold is chosen by


class Fsac(Sac):
    """The FSAC learner. Until its first forecast, or while it does not trust it, it is SAC bit for bit.

    With `parity = "authors"` the past critics are aliases of the live ones. The weights sum to 1, so
    Qtilde = (sum_k w_k) Q = Q: it is SAC throughout.
    """

    algo = "fsac"

    def __init__(
        self, config: LearnerConfig, observation_dim: int, action_dim: int, seed: int, replay: Replay
    ) -> None:
        super().__init__(config, observation_dim, action_dim, seed, replay)
        forecast = config.forecast
        self._history = CriticHistory(
            forecast.l_p, self._critic, self._critic_net, aliases=forecast.parity == "authors"
        )
        self._forecast: Forecast | None = None
        self._judge = Judge(forecast.trust)

    def _build_passes(self) -> None:
        super()._build_passes()
        shape = self.architecture
        widths = [shape.observation_dim + shape.action_dim, *shape.hidden, 1]
        distil = self._config.forecast.distil
        self._distilled = Distilled(widths, self._config.batch, self._precision) if distil else None

    def end_unit(self, unit: int) -> None:
        """Unit t ended: keep the critics, every so many units; not those that have not learnt yet."""
        config = self._config.forecast
        if config.kind != "none" and self.gradient_steps > 0 and (unit + 1) % config.every == 0:
            self._history.push(unit + 1)

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
            self._judge_forecast(previous)
        self._forecast = None
        snapshots = self._history.snapshots
        if config.kind == "none" or not snapshots:
            return
        times = [float(snapshot.time - window.start) for snapshot in snapshots]
        ahead, end = horizon(config, window, self._replay_age(window.start)), window.end
        weights = fit(config, times, ahead)
        judged = weights if end is None else fit(config, times, end - window.start)
        newest = snapshots[-1]
        self._forecast = forecast = Forecast(
            window,
            ahead,
            tuple(weights.tolist()),
            tuple(judged.tolist()),
            snapshots,
            before=newest if newest.time == unit else self._history.take(unit),
        )
        if self._distilled is not None:
            critics = [snapshot.parameters for snapshot in snapshots]
            self._distilled.restart(forecast.weights, critics)

    def outlook(self, start: int, length: int) -> Outlook | None:
        """See `Algorithm`: on a batch of the replay, with `CANDIDATES` of the policy's actions in each state.

        Experimental: SAC's policy is taken to go towards exp(Qtilde / alpha) as a table's would, by
        schedule.rate of the way in a unit, and the best action is the best of the candidates. They are
        drawn from the policy, so a density f becomes f / pi on them.
        """
        snapshots = self._history.snapshots
        if not snapshots or not len(self._replay):
            return None
        self._draw_batch("judge")
        observation = self._sampled.observation
        drawn = [self._propose(self._now, observation, "judge") for _ in range(CANDIDATES)]
        nets = [*(snapshot.net for snapshot in snapshots), self._critic_net]
        values = [
            [smaller(self._evaluate(net, observation, one.action)).double().numpy() for one in drawn]
            for net in nets
        ]
        q = np.stack(values).swapaxes(1, 2)  # [l + 1, states, candidates]
        past, plain, share = q[:-1], q[-1], self._judge.share
        config, times = self._config.forecast, [float(snapshot.time - start) for snapshot in snapshots]
        ahead = horizon(config, Window(0, start, length, 0), self._replay_age(start))
        weights = np.stack([fit(config, times, unit) for unit in (*range(length + 1), ahead)])
        forecasts = share * np.tensordot(weights, past, 1) + (1.0 - share) * plain
        density = np.stack([one.log_prob.double() for one in drawn], -1)
        return Outlook(
            past=past,
            times=np.array(times),
            forecasts=forecasts[:-1],
            target=forecasts[-1] - self._temperature.value * density,
            log_policy=np.full(plain.shape, -np.log(CANDIDATES)),
            rate=self._config.schedule.rate,
            temperature=self._temperature.value,
        )

    def _replay_age(self, unit: int) -> float:
        """Mean age in units, at the start of `unit`, of the transitions that the critics learn from."""
        if not len(self._replay):
            return 0.0
        since, recency = self._since_unit(), self._config.replay_recency
        return max(0.0, unit - (self._replay.mean_unit(since, recency) + 0.5))

    def _judge_forecast(self, forecast: Forecast) -> None:
        """Compare it with the critics reached, at remembered states and actions that nothing learnt from:
        half of them the policy's, half drawn uniformly.
        """
        self._draw_batch("judge")
        observation = self._sampled.observation
        action = self._propose(self._now, observation, "judge").action
        drawn = action[len(action) // 2 :]
        drawn.copy_(torch.from_numpy(self._rng["judge"].uniform(-1, 1, drawn.shape).astype(np.float32)))
        room = self._values
        reached = smaller(self._evaluate(self._critic_net, observation, action))
        before = smaller(room.forward(forecast.before.net))
        error = (forecast.value(room, forecast.judged_weights) - reached).square().mean().sqrt().item()
        self._judge.hear(error, (before - reached).square().mean().sqrt().item())

    def _climb(self) -> tuple[Tensor, Tensor]:
        share = self._judge.share
        if self._forecast is None or share == 0:
            return super()._climb()
        value, slope = self._climb_forecast(self._forecast)
        if share == 1:
            return value, slope
        live_value, live_slope = super()._climb()
        return live_value.lerp_(value, share), live_slope.lerp_(slope, share)

    def _climb_forecast(self, forecast: Forecast) -> tuple[Tensor, Tensor]:
        inputs, action_dim, distilled = self._values.input, self.architecture.action_dim, self._distilled
        if distilled is None:
            return forecast.climb(self._values, action_dim)
        exact = distilled.due()
        distilled.steps += 1
        if not exact:
            return distilled.climb(inputs, action_dim)
        value, slope = forecast.climb(self._values, action_dim)
        distilled.fit(inputs, value, slope)
        return value, slope

    def metrics(self) -> dict[str, float]:
        """Those of SAC, and, where there are forecasts, theirs.

        forecast/snapshots: critics in the forecast now, 0 without one; forecast/weight_norm: its
        ||w||_2, by which noise in past critics is amplified (L of Proposition 1); forecast/horizon: h in
        units; those of `Judge.metrics`, on held-out (s, a); forecast/distil_error: root mean square of
        the distilled forecast minus the exact sum, in standard deviations of the sum, at the policy's
        actions in the newest batch, before it learns from them; forecast/distil_slope: mean cosine of
        their slopes in the action there.
        """
        found, forecast = super().metrics(), self._forecast
        if self._config.forecast.kind == "none":
            return found
        found |= self._judge.metrics()
        found["forecast/snapshots"] = float(len(forecast.snapshots)) if forecast else 0.0
        if forecast:
            found["forecast/weight_norm"] = float(np.linalg.norm(forecast.weights))
            found["forecast/horizon"] = forecast.horizon
        if forecast and self._distilled is not None:
            found |= self._distilled.judged()
        return found

    # -- durability

    def state(self) -> State:
        """That of SAC, with the past critics, the forecast and what became of those before."""
        base, forecast = super().state(), self._forecast
        scalars = base.scalars | {
            "history": [snapshot.time for snapshot in self._history.snapshots],
            "judge": self._judge.state(),
            "forecast": None,
            "distilled_steps": self._distilled.steps if self._distilled is not None else None,
        }
        snapshots = {snapshot.time: snapshot for snapshot in self._history.snapshots}
        if forecast is not None:
            snapshots |= {snapshot.time: snapshot for snapshot in (*forecast.snapshots, forecast.before)}
            scalars["forecast"] = {
                "window": asdict(forecast.window),
                "horizon": forecast.horizon,
                "weights": list(forecast.weights),
                "judged_weights": list(forecast.judged_weights),
                "history": [snapshot.time for snapshot in forecast.snapshots],
                "before": forecast.before.time,
            }
        tensors = dict(base.tensors)
        for snapshot in snapshots.values():
            tensors |= self._history.tensors(snapshot)
        return State(tensors, scalars)

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        super().load(state)
        saved = state.scalars["forecast"]
        kept = {time: self._history.saved(time, state.tensors) for time in _times(state)}
        self._history.restore(tuple(kept[time] for time in state.scalars["history"]))
        self._judge.load(state.scalars["judge"])
        if self._distilled is not None:
            self._distilled.steps = int(state.scalars["distilled_steps"])
            self._distilled.refresh()
        self._forecast = None
        if saved is not None:
            self._forecast = Forecast(
                window=Window(**saved["window"]),
                horizon=float(saved["horizon"]),
                weights=tuple(saved["weights"]),
                judged_weights=tuple(saved["judged_weights"]),
                snapshots=tuple(kept[time] for time in saved["history"]),
                before=kept[saved["before"]],
            )

    def _expected_tensors(self, state: State) -> dict[str, NDArray[Any]]:
        expected = super()._expected_tensors(state)
        for time in _times(state):
            expected |= self._history.expected(time)
        return expected

    def _trained(self) -> dict[str, tuple[FlatParameters, Adam]]:
        found = super()._trained()
        if self._distilled is not None:
            found["distilled"] = self._distilled.parameters, self._distilled.adam
        return found


def _times(state: State) -> list[int]:
    """Of every snapshot in `state`: in the history, in the forecast, or in both."""
    forecast = state.scalars.get("forecast")
    of_forecast = [] if forecast is None else [*forecast["history"], forecast["before"]]
    return sorted({*state.scalars.get("history", []), *of_forecast})
