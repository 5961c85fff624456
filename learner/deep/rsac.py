"""Soft actor-critic on rewards relabelled with a forecast of their drift.

The reward belongs to a family with one drifting number z per unit. Each unit's z is fitted to the unit's
own transitions, the series is forecast to where the policy will act, and every sampled reward is
replaced by what the family pays for that transition under the forecast: old transitions teach the reward
to come. The critics and the policy are plain SAC's, and nothing is extrapolated but one number.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, fields
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import State
from learner.deep.networks import Adam, FlatParameters
from learner.deep.reward_families import Declared, RewardModel
from learner.deep.reward_net import Learned
from learner.deep.sac import Sac
from learner.forecast.scalar import NAMES, Contest, candidates
from learner.replay import Columns, Replay
from rtcore.config import LearnerConfig, RewardConfig
from rtcore.spaces import Spaces
from rtcore.windows import Window

FEW = 10  # transitions of the unit under way, below which its latent is not fitted
LOOKS = 4  # how often the latent of the unit under way is fitted anew, going by the unit before
LOOK_BACK = 100_000  # transitions that are read at once, at most; older ones, after a pause, go unfitted

_REWARD_STREAM = 1  # keeps the reward model's random numbers apart from those of SAC


class Rsac(Sac):
    """The RSAC learner. Until there is a latent it is SAC bit for bit."""

    algo = "rsac"

    def __init__(
        self, config: LearnerConfig, spaces: Spaces, seed: int, replay: Replay, family: RewardConfig
    ) -> None:
        """`family`: the weights of the reward, for `learner.reward.model = "declared"`.

        Raises:
            ConfigError: the declared family's speed is not in the observation.
        """
        super().__init__(config, spaces.observation_dim, spaces.action_dim, seed, replay)
        self._rng["reward"] = np.random.default_rng([seed, _REWARD_STREAM])
        self._model: RewardModel
        if config.reward.model == "declared":
            self._model = Declared(config.reward, family, spaces)
        else:
            self._model = Learned(config.reward, replay, config.batch, self._rng["reward"])
        self._contest = Contest()
        self._window: Window | None = None
        self._unit = -1  # under way, by the clock
        self._looked = 0  # transitions added by the last look at them
        self._newest = -1  # unit of the newest transition looked at
        self._begin = 0  # number of that unit's first transition
        self._stride = 1  # look again after so many transitions
        self._fitted = -1  # newest unit whose latent was fitted
        self._aim: tuple[int, float] | None = None  # unit and lead that the forecast is for
        self._latent: float | None = None  # the forecast
        self._horizon, self._chosen = 0.0, 0

    # -- the drift

    def _draw_batch(self, stream: str = "batches") -> None:
        self._follow()
        super()._draw_batch(stream)
        if self._latent is not None:
            self._batch.reward[:] = self._model.rewards(self._batch, self._latent)

    def _follow(self) -> None:
        """Look at new transitions if they are worth it, and bring the forecast up to date."""
        replay = self._replay
        fresh = replay.added - self._looked
        if fresh >= self._stride or (fresh and replay.newest_unit > self._newest):
            self._look()
            self._aim = None
        unit = max(self._unit, replay.newest_unit)
        aim = unit, acting_lead(self._window, unit)
        if aim != self._aim and self._fitted >= 0:
            self._forecast(*aim)
            self._aim = aim

    def _look(self) -> None:
        """Fit the latents of the units that have new transitions; judge the forecasts of those that ended."""
        replay = self._replay
        seen = replay.read(max(self._begin, replay.added - LOOK_BACK), LOOK_BACK)
        self._begin = replay.added - len(seen.reward)
        for part, ended in _by_unit(seen):
            unit, count = int(part.unit[0]), len(part.reward)
            self._model.begin(unit)
            self._model.learn()
            if ended or count >= FEW:
                self._model.fit(part)
                self._fitted = unit
            if ended:
                before, reached = self._model.series(unit - 1), self._model.series(unit)[-1]
                if len(before):
                    self._contest.judge(before, float(reached))
                self._begin += count
                self._stride = max(1, count // LOOKS)
        self._looked, self._newest = replay.added, replay.newest_unit

    def _forecast(self, unit: int, lead: float) -> None:
        """Read the series `lead` units after `unit`."""
        kind = self._config.reward.forecast
        self._horizon = unit - self._fitted + lead
        self._chosen = self._contest.best if kind == "best" else NAMES.index(kind)
        self._latent = float(candidates(self._model.series(self._fitted), self._horizon)[self._chosen])

    def begin_window(self, window: Window, unit: int) -> None:
        """Window m was entered in `unit`."""
        self._window, self._unit = window, unit

    def end_unit(self, unit: int) -> None:
        """Unit t ended."""
        self._unit = unit + 1

    def metrics(self) -> dict[str, float]:
        """Those of SAC, and of the reward model once it has fitted a unit.

        reward_model/latent: z of the newest unit fitted; /latent_forecast: the one that rewards are
        relabelled with; /horizon: h in units between the two; /chosen: index of the forecaster in
        `learner.forecast.scalar.NAMES`; /residual: root mean square error of the newest fit, per tick;
        /error_<name>: root mean square one-step error of each forecaster, the newer units the heavier.
        """
        found = super().metrics()
        if self._latent is not None:
            found["reward_model/latent"] = float(self._model.series(self._fitted)[-1])
            found["reward_model/latent_forecast"] = self._latent
            found["reward_model/horizon"] = self._horizon
            found["reward_model/chosen"] = float(self._chosen)
            found["reward_model/residual"] = self._model.residual
            errors = zip(NAMES, self._contest.rms().tolist(), strict=True)
            found |= {f"reward_model/error_{name}": error for name, error in errors}
        return found

    # -- durability

    def state(self) -> State:
        """That of SAC, with the reward model and its forecasters' errors."""
        base, model = super().state(), self._model.state()
        own = {
            "window": None if self._window is None else asdict(self._window),
            "errors": self._contest.errors.tolist(),
            "weight": self._contest.weight,
            **{name: getattr(self, f"_{name}") for name in _COUNTS},
        }
        tensors = base.tensors | {f"reward_model.{name}": value for name, value in model.tensors.items()}
        return State(tensors, base.scalars | {"reward_model": model.scalars, "reward_drift": own})

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        super().load(state)
        scalars, own = state.scalars["reward_model"], state.scalars["reward_drift"]
        tensors = {name: state.tensors[f"reward_model.{name}"] for name in self._model.expected(scalars)}
        self._model.load(State(tensors, scalars))
        self._contest.errors, self._contest.weight = np.array(own["errors"]), float(own["weight"])
        self._window = None if own["window"] is None else Window(**own["window"])
        for name in _COUNTS:
            setattr(self, f"_{name}", int(own[name]))
        self._aim = self._latent = None  # made again from the same series by the next update

    def _expected_tensors(self, state: State) -> dict[str, NDArray[Any]]:
        scalars = state.scalars.get("reward_model") or self._model.state().scalars
        wanted = self._model.expected(scalars)
        return super()._expected_tensors(state) | {f"reward_model.{n}": value for n, value in wanted.items()}

    def _trained(self) -> dict[str, tuple[FlatParameters, Adam]]:
        return super()._trained() | self._model.trained()


_COUNTS = ("unit", "looked", "newest", "begin", "stride", "fitted")


def acting_lead(window: Window | None, unit: int) -> float:
    """Units from `unit`, in which the policy is improved, to the middle of the span that it will act in.

    The policy published at the end of a unit acts in the next one: 1. The last one of an update phase
    acts through the hold of N units and on until the next window's first is published, so in N + 1 units,
    whose middle is 1 + N/2 away. In the hold, where only the critics learn, the lead stays. A hold without
    an end has no middle: 1.
    """
    if window is None or not window.hold or unit < window.hold_start - 1:
        return 1.0
    return 1.0 + window.hold / 2


def _by_unit(seen: Columns) -> Iterator[tuple[Columns, bool]]:
    """The transitions of each unit, and whether the unit has ended."""
    edges = [0, *(np.flatnonzero(np.diff(seen.unit)) + 1).tolist(), len(seen.unit)]
    for start, stop in pairwise(edges):
        part = {column.name: getattr(seen, column.name)[start:stop] for column in fields(seen)}
        yield Columns(**part), stop < len(seen.unit)
