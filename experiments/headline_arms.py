"""The paper's Algorithm 1 on tables, its controls, and all of them living through the same worlds at once.

In unit t every arm acts once for H steps with half of its policy and half at random, and learns from that by
Q-learning: Qhat_t. What it then does about its policy is what arms differ in. Unit t's decision acts from
unit t + 1 on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from experiments.headline_worlds import EPISODE_STEPS, GAMMA, Floats, Index, Luck, Worlds
from learner.forecast.forq import fit
from learner.schedule.bound import bound_choice
from learner.schedule.plan import advantage_change, choose, predicted_regret, slope_trust
from learner.tabular.table import mix, npg_step, q_update
from learner.theory.regret import iterates
from rtcore.config import ForecastConfig

WINDOW = 20  # W
TAU = 0.1  # weight of the entropy
STEP_SIZE = 0.3  # of Q-learning
EXPLORE = 0.5  # share of random actions: with the policy's alone, the end that is avoided is never heard of
L_P = 20  # past tables that a forecast is fitted to, a unit apart
MOST = 1.0 / (1.0 - GAMMA)  # no |Q*| is larger, and forecasts are clipped to it


@dataclass(frozen=True)
class Arm:
    """How the policy is made.

    Attributes:
        update: G, units of a window in which the policy is improved; "plan": chosen in each window, as the
            one that the forecasts of all its units predict the least regret for; "bound": the one that
            Theorem 1 is least for, with estimates in it.
        first: whether the hold comes after the update, as in the paper, or before it.
        matched: never hold, and improve in every unit by as little as makes up G steps of the setting's eta.
        refresh: when what the policy is improved towards is made: at t_m, or anew in each unit.
        ahead: which unit that shows: the window's end (the paper), the one that the policy will act in, or
            none: it is the newest table itself. "exact": the true Q* of the window's end, which nobody knows.
        shrink: whether slopes that could be noise count for less.
        least_gain: "plan": hold only if that is predicted to save this share of the regret of no hold.
        least_trust: "plan": hold only if more than this share of the slopes is no noise; None: hold anyway.
        moving: "plan": hold only if some advantage is predicted to change by more than tau in the window.
    """

    update: int | Literal["plan", "bound"] = WINDOW
    first: Literal["update", "hold"] = "update"
    matched: bool = False
    refresh: Literal["window", "unit"] = "window"
    ahead: Literal["end", "next", "none", "exact"] = "end"
    shrink: bool = False
    least_gain: float = 0.0
    least_trust: float | None = None
    moving: bool = False


class Learner:
    """One arm's policy, log pi, [n, S, A] for n lanes.

    Attributes:
        log_policy: of the coming unit; uniform at first.
        update: [n], G of the present window.
    """

    def __init__(self, arm: Arm, eta: float, optimal: Floats) -> None:
        """`optimal` is Q*_t, [T, n, S, A]; "exact" needs the end of every window that it lives in."""
        self._arm = arm
        self._eta = eta
        self._optimal = optimal
        shape = optimal.shape[1:]
        if arm.matched:
            assert isinstance(arm.update, int), "an arm with a rate for G needs a G"
            self._eta = matched_rate(eta, arm.update)
        self.log_policy: Floats = np.full(shape, -np.log(shape[-1]))
        fixed = arm.update if isinstance(arm.update, int) and not arm.matched else WINDOW
        self.update: Index = np.full(shape[0], fixed)
        self._past: Floats = np.zeros((1, *shape))

    def end_unit(self, t: int, tables: Floats) -> None:
        """Decide about unit t + 1, given Qhat of units 0 .. t, [t + 1, n, S, A]."""
        g = t % WINDOW
        end = t - g + WINDOW
        if g == 0 or self._arm.refresh == "unit":
            self._past = tables[-L_P:].copy()
        if g == 0 and self._arm.update == "plan":
            self.update = self._planned()
        if g == 0 and self._arm.update == "bound":
            self.update = self._bounded()
        active = g < self.update if self._arm.first == "update" else g >= WINDOW - self.update
        if active.any():
            target = self._optimal[end] if self._arm.ahead == "exact" else self._target(g)
            stepped = npg_step(self.log_policy, target, eta=self._eta, entropy=TAU, gamma=GAMMA)
            self.log_policy = np.where(active[:, None, None], stepped, self.log_policy)

    def _target(self, g: int) -> Floats:
        if self._arm.ahead == "none":
            newest: Floats = self._past[-1]
            return newest
        if self._arm.ahead == "end":
            return forecast(self._past, WINDOW, shrink=self._arm.shrink)
        ahead = 1 if self._arm.refresh == "unit" else g + 1
        return forecast(self._past, ahead, shrink=self._arm.shrink)

    def _planned(self) -> Index:
        q = np.stack([forecast(self._past, k, shrink=self._arm.shrink) for k in range(WINDOW + 1)])
        made = iterates(self.log_policy, q[-1], WINDOW, eta=self._eta, tau=TAU, gamma=GAMMA)
        least_trust = self._arm.least_trust
        return choose(
            predicted_regret(q, np.exp(made)),
            None if least_trust is None else slope_trust(self._past, np.arange(float(len(self._past)))),
            advantage_change(q) if self._arm.moving else None,
            least_change=TAU,
            least_gain=self._arm.least_gain,
            least_trust=least_trust or 0.0,
        )

    def _bounded(self) -> Index:
        target = forecast(self._past, WINDOW, shrink=False)
        slope = np.tensordot(_weights(len(self._past), 1) - _weights(len(self._past), 0), self._past, 1)
        return bound_choice(
            self.log_policy, target, slope, window=WINDOW, eta=self._eta, tau=TAU, gamma=GAMMA
        )


def matched_rate(eta: float, update: int) -> float:
    """The rate that W steps with move the policy as far towards a fixed target as G steps with `eta`.

    A step keeps the share beta = 1 - eta tau / (1 - gamma) of the old log pi: beta'^W = beta^G.
    """
    kept = 1.0 - eta * TAU / (1.0 - GAMMA)
    return float((1.0 - kept ** (update / WINDOW)) * (1.0 - GAMMA) / TAU)


def forecast(past: Floats, ahead: float, *, shrink: bool) -> Floats:
    """ForQ of tables of neighbouring units, [l, ..., S, A], `ahead` units after the last; clipped.

    With `shrink` the slopes are multiplied by their `slope_trust`, one number per lane, so that the weights
    remain the same for every (s, a).
    """
    fitted = np.tensordot(_weights(len(past), ahead), past, 1)
    if shrink and len(past) > 2:
        mean = past.mean(0)
        fitted = mean + slope_trust(past, np.arange(float(len(past))))[..., None, None] * (fitted - mean)
    clipped: Floats = np.clip(fitted, -MOST, MOST)
    return clipped


@lru_cache(maxsize=1024)
def _weights(known: int, ahead: float) -> Floats:
    return fit(ForecastConfig(basis="identity"), list(np.arange(1.0 - known, 1.0)), ahead)


def live(worlds: Worlds, arms: Sequence[Arm], eta: float, luck: Luck) -> tuple[Floats, Floats]:
    """All arms with the same chance.

    Returns:
        V*_t - V^{pi_t}_t, exact, and G of the window that the unit is in, both [arms, T, n].
    """
    units = len(luck.start)
    best = worlds.optimal()
    lanes, states, actions = best.q.shape[1:]
    learners = [Learner(arm, eta, best.q) for arm in arms]
    tables = np.zeros((units, len(arms), lanes, states, actions))
    policies = np.empty_like(tables)
    update = np.zeros((len(arms), units, lanes))
    q = np.zeros((len(arms) * lanes, states, actions))
    rollout = _Rollout(worlds, len(arms), luck)
    for t in range(units):
        policies[t] = np.exp([learner.log_policy for learner in learners])
        rollout.learn(q, policies[t].reshape(q.shape), t)
        tables[t] = q.reshape(tables[t].shape)
        for i, learner in enumerate(learners):
            learner.end_unit(t, tables[max(0, t + 1 - L_P) : t + 1, i])
            update[i, t] = learner.update
    regret = [best.v[:units] @ worlds.start - worlds.lived(policies[:, i]) for i in range(len(arms))]
    return np.stack(regret), update


class _Rollout:
    """A unit's trajectory of every lane of every arm, learned from by Q-learning."""

    def __init__(self, worlds: Worlds, arms: int, luck: Luck) -> None:
        self._reward = worlds.reward
        self._moves = worlds.transition.cumsum(-1)[..., :-1]
        self._luck = luck
        self._arms = arms
        self._lane = np.tile(np.arange(worlds.reward.shape[1]), arms)  # in the worlds, of each row of q

    def learn(self, q: Floats, policy: Floats, t: int) -> None:
        """Unit t with pi, [L, S, A]; `q` in place."""
        acts = mix(policy, EXPLORE).cumsum(-1)[..., :-1]
        row, lane, luck = np.arange(len(q)), self._lane, self._luck
        never = np.zeros(len(q), np.bool_)
        state = np.tile((luck.start[t] * q.shape[1]).astype(np.int64), self._arms)
        for h in range(EPISODE_STEPS):
            action = _pick(acts[row, state], luck.action[t, h][lane])
            following = _pick(self._moves[lane, state, action], luck.move[t, h][lane])
            reward = self._reward[t, lane, state, action]
            q_update(q, state, action, reward, following, never, step_size=STEP_SIZE, gamma=GAMMA)
            state = following


def _pick(summed: Floats, uniform: Floats) -> Index:
    """Which of the numbers 0 .. k, [L], from the first k of their summed probabilities, [L, k]."""
    picked: Index = (uniform[:, None] >= summed).sum(-1)
    return picked
