"""Exact dynamic regret of what a run executed, from its configuration and its learner's diary.

In a finite world R_t and P_t are known, and so V*_t and the value of every policy that acted. A unit's
regret is V*_t - V^pi_t, infinite horizon, discounted with `learner.gamma`, of the policy pi that acted; the
mean over the unit's ticks, if several did (paper, section 3; by phase, section 5.1). The environments of a
fleet are one world at one unit: the ticks are those of all.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from env_server.worlds.finite import FiniteWorld, Tables
from env_server.worlds.names import FINITE_WORLDS
from env_server.worlds.registry import make_world
from launcher.bounds import MOST_US, certify, solving_us, with_end
from launcher.summary import Summary
from learner import diary
from learner.diary import Acted, Entered, Entry, Forecast, Published
from learner.theory import values
from rtcore.config import ConfigError, RunConfig
from rtcore.messages import Phase
from rtcore.run_dir import RunDir

Floats = NDArray[np.float64]


class NotComputableError(Exception):
    """Why there is no exact regret."""


@dataclass
class LivedUnit:
    """Unit t as it was lived: ticks by version of the policy that acted."""

    unit: int
    ticks: Counter[int] = field(default_factory=Counter)


class Lived(NamedTuple):
    """What a diary says.

    Attributes:
        units: in the order of time, those with a tick whose policy is known.
        left_out: ticks in which a fallback acted, or a policy of which there is no table, or two.
        policies: pi(a|s) by version, [S, A], of those that acted; 0 is uniform.
        phases: as they began, oldest first.
        windows: as they began, of Algorithm 1.
    """

    units: list[LivedUnit]
    left_out: int
    policies: dict[int, Floats]
    phases: list[Entered]
    windows: list[Forecast]


class Losses(NamedTuple):
    """V*_t - V^pi_t of each unit, [n]: from the world's start, and in the unit's worst state."""

    start: Floats
    worst: Floats


def of_run(config: RunConfig, run_dir: RunDir) -> Summary:
    """The summary's entries `regret` and `regret_missing`: why there is none, where it is null."""
    try:
        return {"regret": _regret(config, run_dir), "regret_missing": None}
    except NotComputableError as reason:
        return {"regret": None, "regret_missing": str(reason)}
    except (ConfigError, OSError) as error:
        return {"regret": None, "regret_missing": f"cannot be computed: {error}"}


def read_lived(entries: Iterable[Entry], states: int, actions: int) -> Lived:
    """Add up a diary. `states` and `actions` are the world's."""
    policies, ambiguous = {0: np.full((states, actions), 1.0 / actions)}, set[int]()
    units: dict[int, LivedUnit] = {}
    phases, windows = [], []
    for entry in entries:
        match entry:
            case Published():
                table = entry.probability
                if not np.array_equal(policies.setdefault(entry.version, table), table):
                    ambiguous.add(entry.version)  # killed while it published, the learner made another
            case Acted():
                units.setdefault(entry.unit, LivedUnit(entry.unit)).ticks.update(entry.ticks)
            case Entered():
                phases.append(entry)
            case Forecast():
                windows.append(entry)
    known = {version: table for version, table in policies.items() if version not in ambiguous}
    left_out = 0
    for unit in units.values():
        unknown = [version for version in unit.ticks if version not in known]
        left_out += sum(unit.ticks.pop(version) for version in unknown)
    lived = [units[unit] for unit in sorted(units) if units[unit].ticks]
    acted = {version: known[version] for unit in lived for version in unit.ticks}
    return Lived(lived, left_out, acted, sorted(phases, key=lambda one: one.run_ns), windows)


def losses(
    world: FiniteWorld, gamma: float, units: Sequence[LivedUnit], policies: Mapping[int, Floats]
) -> Losses:
    """The regret of each unit; where several policies acted, their mean by ticks.

    Raises:
        NotComputableError: it would take too long.
    """
    drifts = {world.drift(one.unit) for one in units}
    solved = sum(len(one.ticks) for one in units)
    if (8 * len(drifts) + solved) * solving_us(len(world.starts())) > MOST_US:
        raise NotComputableError(f"{len(units)} units of {world.states} states would take too long")
    best: dict[float, tuple[Tables, Floats]] = {}  # the drift alone moves the world
    start, worst = np.zeros(len(units)), np.zeros(len(units))
    for i, one in enumerate(units):
        drift = world.drift(one.unit)
        if drift not in best:
            tables = world.tables(one.unit)
            best[drift] = tables, values.optimal(tables.reward, tables.transition, gamma=gamma).v
        tables, optimum = best[drift]
        acted = np.stack(
            [with_end(policies[version], len(optimum), 1 / world.actions) for version in one.ticks]
        )
        lived = values.evaluate(tables.reward, tables.transition, acted, gamma=gamma).v
        lost, share = optimum - lived, np.array(list(one.ticks.values())) / one.ticks.total()
        start[i], worst[i] = share @ lost @ world.starts(), share @ lost.max(-1)
    return Losses(start, worst)


def phase_at(phases: Sequence[Entered], run_ns: int) -> Phase:
    """The phase of an instant since T0; before the first one it is an update phase."""
    begun = bisect_right(phases, run_ns, key=lambda one: one.run_ns)
    return phases[begun - 1].phase if begun else "update"


def _regret(config: RunConfig, run_dir: RunDir) -> Summary:
    if config.env.id not in FINITE_WORLDS:
        raise NotComputableError("V* is not known in a continuous world")
    if config.env.action_delay_ticks:
        raise NotComputableError("with env.action_delay_ticks > 0 the state is more than the observation")
    if config.learner.gamma == 1:
        raise NotComputableError("with learner.gamma = 1 a policy that never ends an episode has no value")
    found = diary.read(run_dir.learner_dir / diary.NAME)
    with closing(make_world(config.env, config.seed)) as world:
        assert isinstance(world, FiniteWorld)
        lived = read_lived(found.entries, world.states, world.actions)
        if not lived.units:
            raise NotComputableError("the learner's diary has no tick of a known policy")
        lost = losses(world, config.learner.gamma, lived.units, lived.policies)
        bounds = certify(config, world, lived.windows)
    unit_ns = round(config.env.unit_s * 1e9)
    holding = np.array([phase_at(lived.phases, one.unit * unit_ns) == "hold" for one in lived.units])
    return {
        "units": len(lived.units),
        "update_units": int((~holding).sum()),
        "hold_units": int(holding.sum()),
        "ticks": sum(one.ticks.total() for one in lived.units),
        "left_out_ticks": lived.left_out,
        **_sums(lost.start, holding),
        "worst_state": _sums(lost.worst, holding),
        **bounds,
    }


def _sums(lost: Floats, holding: NDArray[np.bool_]) -> Summary:
    return {
        "per_unit": float(lost.mean()),
        "total": float(lost.sum()),
        "update": float(lost[~holding].sum()),
        "hold": float(lost[holding].sum()),
    }
