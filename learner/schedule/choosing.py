"""How long a window is updated in, chosen from what is foreseen of it, and said in words. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from learner.schedule.bound import bound_choice
from learner.schedule.outlook import Outlook
from learner.schedule.plan import LEAST_TRUST, advantage_change, choose, predicted_regret, slope_trust
from rtcore.config import LearnerConfig, ScheduleConfig
from rtcore.windows import update_units


@dataclass(frozen=True, slots=True)
class Choice:
    """G of a window of W units, and why.

    Attributes:
        update: G, in 1 .. W.
        why: in words.
        predicted: regret foreseen with it, summed over the window; NaN where nothing was foreseen.
        unheld: regret foreseen with G = W, no hold; NaN likewise.
        trust: how much of the change that was seen is not noise, in [0, 1]; NaN likewise.
    """

    update: int
    why: str
    predicted: float = np.nan
    unheld: float = np.nan
    trust: float = np.nan


def fall_back(config: ScheduleConfig, known: int, needed: int) -> Choice:
    """While too little is known: as declared by l_f, gamma_f and rounding, within the limits."""
    update = max(update_units(config.l_f, config.gamma_f, config.rounding), config.least_update)
    return Choice(update, f"as declared, for {known} of {needed} past Q functions are there")


def by_forecasts(config: ScheduleConfig, outlook: Outlook) -> Choice:
    """`auto`: the G of the least regret that forecasts of all the window's units predict."""
    predicted = predicted_regret(outlook.forecasts, outlook.policies())
    trust = float(slope_trust(outlook.past, outlook.times))
    change = float(advantage_change(outlook.forecasts))
    found = choose(
        predicted,
        np.array(trust),
        np.array(change),
        least_change=outlook.temperature,
        least_gain=config.least_gain,
        least_trust=LEAST_TRUST,
        least_update=config.least_update,
    )
    update = int(found)
    chosen, unheld = float(predicted[update - 1]), float(predicted[-1])
    if trust <= LEAST_TRUST:
        why = f"the change of Q is hardly told from noise (trust {trust:.2f})"
    elif change <= outlook.temperature:
        why = f"no advantage is predicted to change by more than the temperature {outlook.temperature:.3g}"
    elif unheld == 0:
        why = "no regret is predicted"
    elif update == config.l_f:
        why = f"no hold is predicted to save {config.least_gain:.0%} of the regret {unheld:.3g}"
    else:
        why = f"predicted regret {chosen:.3g}, {1 - chosen / unheld:.0%} below {unheld:.3g} without a hold"
    return Choice(update, why, chosen, unheld, trust)


def by_bound(config: ScheduleConfig, outlook: Outlook, learner: LearnerConfig) -> Choice:
    """`auto_bound`: the G of the least bound, its constants from what was seen last."""
    centred = outlook.times - outlook.times.mean()
    slope = np.tensordot(centred, outlook.past, 1) / float((centred**2).sum())
    update = bound_choice(
        outlook.log_policy,
        outlook.target,
        slope,
        window=config.l_f,
        eta=learner.table.eta,
        tau=learner.table.entropy,
        gamma=learner.gamma,
    )
    limited = max(int(update), config.least_update)
    return Choice(limited, f"the bound's N*, with Q changing by {np.abs(slope).max():.3g} a unit")
