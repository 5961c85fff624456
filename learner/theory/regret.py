"""Exact dynamic regret of what was executed, by unit and by phase (paper, section 3, "Dynamic regret").

Units count from 0 to T - 1 and windows are half-open. The paper's sums run from t = 1 although t_1 = 0,
and from t_m to t_{m+1} inclusive, which counts every window's first unit twice.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from learner.tabular.table import npg_step
from learner.theory import values
from learner.theory.bounds import check_rate
from learner.theory.mdp import Floats, TimeElapsingMdp, check_discount, check_policies
from rtcore.config import ConfigError
from rtcore.windows import Schedule


class PhaseRegret(NamedTuple):
    """Regret summed over the units of the update phases, and of the holds (paper, section 5.1)."""

    update: float
    hold: float

    @property
    def total(self) -> float:
        """R(T)."""
        return self.update + self.hold


def per_unit(
    world: TimeElapsingMdp, policies: Floats, *, first: int = 0, start: Floats | None = None
) -> Floats:
    """V*_t - V^{pi_t}_t for each executed policy, [n], each >= 0 but for rounding.

    Args:
        world: of at least first + n units.
        policies: pi_t(a|s) of the units first, first + 1, ..., [n, S, A].
        first: the unit of the first policy.
        start: distribution of the first state, [S]; None: the worst state of each unit, as in the bounds.

    Raises:
        ConfigError: a policy or a start that is no distribution, or units that the world has not.
    """
    number = len(policies)
    if first < 0 or not 1 <= number <= world.units - first:
        raise ConfigError("units", (first, first + number), f"must be one or more within [0, {world.units})")
    policies = check_policies("policies", policies, (number, world.states, world.actions))
    reward, transition = world.reward[first : first + number], world.transition[first : first + number]
    best = values.optimal(reward, transition, gamma=world.gamma, horizon=world.horizon).v
    lived = values.evaluate(reward, transition, policies, gamma=world.gamma, horizon=world.horizon).v
    gap: Floats = best - lived
    if start is None:
        worst: Floats = gap.max(-1)
        return worst
    return gap @ check_policies("start", start, (world.states,))


def by_phase(regret: Floats, schedule: Schedule, *, first: int = 0) -> PhaseRegret:
    """The regret of the units first, first + 1, ..., [n], summed by the phase that each lies in.

    Unit t is updated in if t is in [t_m, t_m + G_m), although it is executed with pi^g of g = t - t_m.

    Raises:
        ConfigError: the regret is not of one number per unit.
    """
    if np.ndim(regret) != 1:
        raise ConfigError("regret.shape", np.shape(regret), "must be [n], one number per unit")
    windows = (schedule.window_at(first + i) for i in range(len(regret)))
    updating = np.array([first + i < window.hold_start for i, window in enumerate(windows)], bool)
    return PhaseRegret(float(regret[updating].sum()), float(regret[~updating].sum()))


def iterates(
    log_policy: Floats, forecast: Floats, number: int, *, eta: float, tau: float, gamma: float
) -> Floats:
    """What one window of Algorithm 1 makes, log pi^0 .. log pi^G, [G + 1, S, A], all from one forecast.

    Args:
        log_policy: log pi_{t_m}, [S, A].
        forecast: Qtilde_{t_{m+1}|t_m}, [S, A].
        number: G >= 0.
        eta: learning rate, in (0, (1 - gamma) / tau].
        tau: weight of the entropy, > 0, in units of reward.
        gamma: discount per step.

    Raises:
        ConfigError: G < 0, tables of different shapes, or an eta, a tau or a gamma out of its range.
    """
    check_discount(gamma, None)
    check_rate(eta, tau, gamma)
    if number < 0:
        raise ConfigError("number", number, "must be >= 0: G of the window")
    if np.shape(log_policy) != np.shape(forecast):
        raise ConfigError(
            "forecast.shape", np.shape(forecast), f"must be log_policy's, {np.shape(log_policy)}"
        )
    made = [log_policy]
    for _ in range(number):
        made.append(npg_step(made[-1], forecast, eta=eta, entropy=tau, gamma=gamma))
    return np.stack(made)


def executed(log_iterates: Floats, hold: int) -> Floats:
    """pi_t of a window's units t_m .. t_{m+1} - 1, [G + N, S, A]: pi^0 .. pi^{G-1}, then pi^G held."""
    if hold < 0:
        raise ConfigError("hold", hold, "must be >= 0: N of the window")
    update = len(log_iterates) - 1
    return np.exp(log_iterates[np.minimum(np.arange(update + hold), update)])
