"""What theory allows the windows of a run of Algorithm 1 to lose, beside what its policies lose."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from env_server.worlds.finite import FiniteWorld
from launcher.summary import Summary
from learner.diary import Forecast
from learner.theory import certificates, regret
from learner.theory.certificates import Case
from learner.theory.mdp import TimeElapsingMdp
from rtcore.config import ConfigError, RunConfig, TableConfig

Floats = NDArray[np.float64]

MOST_US = (
    1_000_000  # estimated; a run that was interrupted should end within 5 s, mostly spent on other things
)
_WINDOW_US = 3000.0
_SAME = 1e-9  # of log pi: a window's last iterate made again, and as the next one began with it


def certify(config: RunConfig, world: FiniteWorld, windows: Sequence[Forecast]) -> Summary:
    """The entries `bounds` and `bounds_missing`: why there are none, where it is null.

    Of every window that was lived as scheduled: the regret of the policies that Algorithm 1 makes, in the
    worst states, and what each form of `learner.theory.certificates` allows it; each summed over the windows.
    Each window's r_max is the largest reward in it.

    Args:
        config: of the run.
        world: its world.
        windows: as they began.
    """
    if config.learner.algo != "npg":
        return _without("the theory is of Algorithm 1, learner.algo = 'npg'")
    try:
        whole = complete(windows, config.learner.table, config.learner.gamma)
        if not whole:
            return _without("no window was lived as scheduled, from its begin into the next one")
        if sum(_cost_us(len(world.starts()), window) for window in whole) > MOST_US:
            return _without(f"{len(whole)} windows of {world.states} states would take too long")
        return {"bounds": _sum_up(config, world, whole), "bounds_missing": None}
    except ConfigError as error:
        return _without(str(error))


def complete(windows: Sequence[Forecast], table: TableConfig, gamma: float) -> list[Forecast]:
    """Those that were entered at t_m, and followed at t_{m+1} by one that begins with pi^G.

    So nobody held them, and none of their iterations is missing.
    """
    found = []
    for window, after in pairwise(windows):
        end = None if window.hold is None else window.start + window.update + window.hold
        if (window.unit, after.unit, after.start) != (window.start, end, end):
            continue
        forecast, log_policy = window.tables()
        made = regret.iterates(
            log_policy, forecast, window.update, eta=table.eta, tau=table.entropy, gamma=gamma
        )
        if np.allclose(made[-1], after.tables()[1], rtol=0, atol=_SAME):
            found.append(window)
    return found


def case_of(config: RunConfig, world: FiniteWorld, window: Forecast) -> Case:
    """A complete window in its world: units 0 .. G + N are t_m .. t_{m+1}.

    Raises:
        ConfigError: it is none that theory speaks of.
    """
    assert window.hold is not None
    length = window.update + window.hold
    tables = [world.tables(window.start + i) for i in range(length + 1)]
    reward = np.stack([one.reward for one in tables])
    transition = np.stack([one.transition for one in tables])
    forecast, log_policy = window.tables()
    states, actions = reward.shape[1:]
    return Case(
        world=TimeElapsingMdp(reward, transition, config.learner.gamma),
        begin=0,
        update=window.update,
        hold=window.hold,
        log_policy=with_end(log_policy, states, -np.log(actions)),
        forecast=with_end(forecast, states, 0.0),
        eta=config.learner.table.eta,
        tau=config.learner.table.entropy,
    )


def with_end(table: Floats, states: int, value: float) -> Floats:
    """[S, A] with a row of `value` for the end of an episode, if `states` says that there is one."""
    return np.concatenate([table, np.full((states - len(table), table.shape[1]), value)])


def _without(reason: str) -> Summary:
    return {"bounds": None, "bounds_missing": reason}


def solving_us(states: int) -> float:
    """About how long it takes to evaluate a policy; to find the best one takes some eight times as long.

    Measured: 0.04 ms with 5 states, 0.07 with 37, 2.9 with 300.
    """
    return 40.0 + 1e-4 * states**3


def _cost_us(states: int, window: Forecast) -> float:
    length = window.update + (window.hold or 0)
    solved = 8 * (2 * length + 4) + length + 2 * window.update + 20
    return _WINDOW_US + solved * 1e-3 * states**3  # 37 states, G = 2: 7 ms; with more it is too much


def _sum_up(config: RunConfig, world: FiniteWorld, windows: Sequence[Forecast]) -> Summary:
    update = hold = 0.0
    allowed = dict.fromkeys(("printed", "repaired", "proven", "gibbs"), 0.0)
    for window in windows:
        case = case_of(config, world, window)
        lost = certificates.measured(case)
        update += float(lost[: case.update].sum())
        hold += float(lost[case.update :].sum())
        allowed["printed"] += certificates.printed(case).total
        allowed["repaired"] += certificates.repaired(case).total
        allowed["proven"] += certificates.proven(case).total
        allowed["gibbs"] += float(certificates.gibbs(case).sum())
    return {
        "windows": len(windows),
        "units": sum(window.update + (window.hold or 0) for window in windows),
        # of the policies without the random actions that table.epsilon adds, which no bound speaks of
        "iterates_worst_state": {"total": update + hold, "update": update, "hold": hold},
        **allowed,
    }
