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
from learner.tabular.table import mix, npg_step, q_update
from learner.theory.regret import iterates
from rtcore.config import ForecastConfig

WINDOW = 20  # W
TAU = 0.1  # weight of the entropy
STEP_SIZE = 0.3  # of Q-learning
EXPLORE = 0.5  # share of random actions: with the policy's alone, the end that is avoided is never heard of
L_P = 20  # past tables that a forecast is fitted to, a unit apart
MOST = 1.0 / (1.0 - GAMMA)  # no |Q*| is larger, and forecasts are clipped to it
SHRINK = 10.0  # times the slopes' variance; residuals of neighbouring tables are far from independent


@dataclass(frozen=True)
class Arm:
    """How the policy is made.

    Attributes:
        update: G, units of a window in which the policy is improved; "plan": chosen in each window, as the
            one that the forecasts of all its units predict the least regret for.
        first: whether the hold comes after the update, as in the paper, or before it.
        matched: never hold, and improve in every unit by as little as makes up G steps of the setting's eta.
        refresh: when what the policy is improved towards is made: at t_m, or anew in each unit.
        ahead: which unit that shows: the window's end (the paper), the one that the policy will act in, or
            none: it is the newest table itself. "exact": the true Q* of the window's end, which nobody knows.
        shrink: whether slopes that could be noise count for less.
        least_gain: "plan": hold only if that is predicted to save this share of the regret of no hold.
    """

    update: int | Literal["plan"] = WINDOW
    first: Literal["update", "hold"] = "update"
    matched: bool = False
    refresh: Literal["window", "unit"] = "window"
    ahead: Literal["end", "next", "none", "exact"] = "end"
    shrink: bool = False
    least_gain: float = 0.0


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
            assert arm.update != "plan", "an arm with a rate for G needs a G"
            self._eta = matched_rate(eta, arm.update)
        self.log_policy: Floats = np.full(shape, -np.log(shape[-1]))
        self.update: Index = np.full(shape[0], WINDOW if arm.update == "plan" or arm.matched else arm.update)
        self._past: Floats = np.zeros((1, *shape))

    def end_unit(self, t: int, tables: Floats) -> None:
        """Decide about unit t + 1, given Qhat of units 0 .. t, [t + 1, n, S, A]."""
        g = t % WINDOW
        end = t - g + WINDOW
        if g == 0 or self._arm.refresh == "unit":
            self._past = tables[-L_P:].copy()
        if g == 0 and self._arm.update == "plan":
            self.update = self._planned()
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
        return plan(q, np.exp(made), least_gain=self._arm.least_gain)


def matched_rate(eta: float, update: int) -> float:
    """The rate that W steps with move the policy as far towards a fixed target as G steps with `eta`.

    A step keeps the share beta = 1 - eta tau / (1 - gamma) of the old log pi: beta'^W = beta^G.
    """
    kept = 1.0 - eta * TAU / (1.0 - GAMMA)
    return float((1.0 - kept ** (update / WINDOW)) * (1.0 - GAMMA) / TAU)


def forecast(past: Floats, ahead: float, *, shrink: bool) -> Floats:
    """ForQ of tables of neighbouring units, [l, ..., S, A], `ahead` units after the last; clipped.

    With `shrink` the slopes are multiplied by rho = clip(1 - 10 sum se^2 / sum slope^2, 0, 1), one number per
    lane, so that the weights remain the same for every (s, a): after James and Stein (1961), se^2 being the
    slopes' variance if the residuals were independent.
    """
    fitted = np.tensordot(_weights(len(past), ahead), past, 1)
    if shrink and len(past) > 2:
        mean = past.mean(0)
        fitted = mean + _trust(past)[..., None, None] * (fitted - mean)
    clipped: Floats = np.clip(fitted, -MOST, MOST)
    return clipped


def _trust(past: Floats) -> Floats:
    number = len(past)
    time = np.arange(number) - (number - 1) / 2
    spread = float((time**2).sum())
    slope = np.tensordot(time, past, 1) / spread
    residual = past - past.mean(0) - np.multiply.outer(time, slope)
    variance = (residual**2).sum((0, -2, -1)) / ((number - 2) * spread)
    size = (slope**2).sum((-2, -1))
    trust: Floats = np.clip(1.0 - SHRINK * variance / np.maximum(size, 1e-300), 0.0, 1.0)
    return trust


@lru_cache(maxsize=1024)
def _weights(known: int, ahead: float) -> Floats:
    return fit(ForecastConfig(basis="identity"), list(np.arange(1.0 - known, 1.0)), ahead)


def plan(q: Floats, policy: Floats, *, least_gain: float = 0.0) -> Index:
    """The G in 1 .. W of the least predicted regret, of each lane, [n].

        predicted(G) = sum_{k=0}^{W} mean_s [max_a Qtilde_k(s, a) - sum_a pi^{min(k, G)}(a|s) Qtilde_k(s, a)]

    The last unit, t_{m+1}, counts: pi^G still acts in it.

    Args:
        q: Qtilde_{t_m + k}, [W + 1, n, S, A].
        policy: pi^g, [W + 1, n, S, A].
        least_gain: G = W unless another one saves this share of what is predicted for W.
    """
    earned = np.einsum("knsa,gnsa->kgn", q, policy) / q.shape[2]
    gap = q.max(-1).mean(-1)[:, None] - earned
    k = np.arange(len(q))
    predicted = np.stack([gap[k, np.minimum(k, update)].sum(0) for update in k[1:]])
    gain = predicted[-1] - predicted.min(0)
    return np.where(gain < least_gain * predicted[-1], len(predicted), predicted.argmin(0) + 1)


def live(worlds: Worlds, arms: Sequence[Arm], eta: float, luck: Luck) -> tuple[Floats, Floats]:
    """All arms with the same chance.

    Returns:
        V*_t - V^{pi_t}_t, exact, [arms, T, n]; and the mean G of each arm's windows, [arms, n].
    """
    units = len(luck.start)
    best = worlds.optimal()
    lanes, states, actions = best.q.shape[1:]
    learners = [Learner(arm, eta, best.q) for arm in arms]
    tables = np.zeros((units, len(arms), lanes, states, actions))
    policies = np.empty_like(tables)
    held = np.zeros((len(arms), lanes))
    q = np.zeros((len(arms) * lanes, states, actions))
    rollout = _Rollout(worlds, len(arms), luck)
    for t in range(units):
        policies[t] = np.exp([learner.log_policy for learner in learners])
        rollout.learn(q, policies[t].reshape(q.shape), t)
        tables[t] = q.reshape(tables[t].shape)
        for i, learner in enumerate(learners):
            learner.end_unit(t, tables[max(0, t + 1 - L_P) : t + 1, i])
            held[i] += learner.update / units
    regret = [best.v[:units] @ worlds.start - worlds.lived(policies[:, i]) for i in range(len(arms))]
    return np.stack(regret), held


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
