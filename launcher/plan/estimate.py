"""The constants of a plan from a run: what its recording shows, what its configuration says, what is assumed.

Estimated is the variation budget: from the drift in each unit follows how much the reward has changed
(`local_changes`), from that and from the windows the budget B(t1, t1 + j) since each window's begin and since
each hold's, and over these the least envelope B alpha^j, as Assumption 1 asks for (`launcher.plan.envelope`).
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from env_server.worlds import registry as worlds
from env_server.worlds.mdp import DriftingMdp
from env_server.worlds.names import BANDIT, CHAIN, CLIFFWORLD, RANDOM_MDP
from launcher.plan.constants import Estimate, Number
from launcher.plan.envelope import fit
from launcher.report import load
from learner.theory.mdp import discounted_index, discounted_steps
from recorder.reading import columns
from rtcore.cast import env_names
from rtcore.config import ConfigError, EnvConfig, RunConfig
from rtcore.run_dir import RunDir

Floats = NDArray[np.float64]

ASSUMED_ETA, ASSUMED_TAU = 1.0, 0.1  # eta tau of the paper's panels, where a learner has no such thing


def from_run(path: Path, length: int | None = None) -> Estimate:
    """Constants from a run's directory; `length` is the window W in units, if not the run's own.

    Raises:
        ConfigError: no such run, no recording, no window that ended, or a discount of 1.
    """
    run_dir = RunDir(path)
    summary, config = load(run_dir), run_dir.config()
    try:
        windows = [(one["t_m"], one["G"], one["N"]) for one in summary["windows"] if one["N"] is not None]
    except (KeyError, TypeError) as error:
        raise ConfigError("run", str(path), f"its summary.json lacks {error}") from error
    drift, reward = _recorded(run_dir, config.env)
    ended = [window for window in windows if sum(window) < len(drift)]
    if not ended:
        raise ConfigError("run", str(path), "needs a window that ended while it was recorded")
    if length is None:
        length = Counter(G + N for _, G, N in ended).most_common(1)[0][0]
    changes, how, dynamics = local_changes(config, drift, float(np.ptp(reward)))
    updates = [t_m for t_m, _, _ in ended]
    holds = [t_m + G for t_m, G, N in ended if N]
    envelopes = fit(changes, updates, length), fit(changes, holds or updates, length)
    values, origins = _scales(config, reward, dynamics=dynamics)
    values["window"], origins["window"] = length, f"the run's {len(ended)} windows"
    for phase, (envelope, begins) in enumerate(zip(envelopes, ("update", "hold"), strict=True), start=1):
        values[f"alpha_{phase}"], values[f"b_{phase}"] = envelope.growth, envelope.scale
        told = f"estimated: {envelope.begins} {begins if holds else 'window'} begins"
        origins[f"alpha_{phase}"] = origins[f"b_{phase}"] = told
    remarks = how, *_remarks(config, has_holds=bool(holds), moved=any(one.scale for one in envelopes))
    return Estimate(values, origins, config.env.unit_s, remarks, envelopes)


def local_changes(config: RunConfig, drift: Floats, reward_range: float) -> tuple[Floats, str, bool]:
    """How much the world changes from each unit to the next: max(b_r[t], b_p[t]) (paper, section 3).

    Args:
        config: the run's.
        drift: its value in each unit, [T].
        reward_range: of the recorded rewards, for the worlds where only this bounds a change.

    Returns:
        [T - 1], how it was found, and whether the dynamics are in it.
    """
    env = config.env
    steps: Floats = np.abs(np.diff(drift))
    if env.drift.still:
        return np.zeros_like(steps), "the reward does not drift", False
    if env.id == BANDIT:
        chances: Floats = np.abs(np.diff(np.clip(drift, 0.0, 1.0)))
        return chances, "b_r is exact: the step of the arms' chances", False
    if env.id == CLIFFWORLD:
        jumps = np.where(steps > 0, reward_range, 0.0)
        return jumps, "b_r is at most the rewards' range, whenever the drift moved", False
    if env.id in (CHAIN, RANDOM_MDP):
        world = worlds.make_world(env, config.seed)
        assert isinstance(world, DriftingMdp)
        b_r, b_p = world.budgets(len(steps))
        both: Floats = np.stack((b_r, b_p)).max(axis=0)
        return both, "b_r and b_p are exact, from the world's tables", bool(b_p.any())
    return steps, "b_r is exact: the reward holds -|k_f v - v_d(t)|, so b_r is the step of v_d", False


def _recorded(run_dir: RunDir, env: EnvConfig) -> tuple[Floats, Floats]:
    """The drift in each unit from 0 on, and all rewards; of a fleet, of its first environment: the drift is
    the same in all.

    Raises:
        ConfigError: there is no recording, or it holds nothing or cannot be read.
    """
    path, root = run_dir.recording_path, f"/{env_names(env)[0]}" if env.count > 1 else ""
    if not path.is_file():
        raise ConfigError("run", str(run_dir.path), "needs a recording.rrd in it")
    try:
        units, drift = columns(path, f"{root}/env/drift", timeline="unit")
        _, reward = columns(path, f"{root}/env/reward", timeline="unit")
    except RuntimeError as error:
        raise ConfigError("run", str(run_dir.path), f"its recording.rrd cannot be read: {error}") from error
    if not len(units) or not len(reward):
        raise ConfigError("run", str(run_dir.path), "its recording.rrd holds no steps")
    # In units without a step of their own, lost to an overrun, the last value goes on.
    newest = np.searchsorted(units, np.arange(units[-1] + 1), side="right") - 1
    return drift[newest.clip(0), 0], reward[:, 0]


def _scales(config: RunConfig, reward: Floats, *, dynamics: bool) -> tuple[dict[str, Number], dict[str, str]]:
    """C_1, C_4 + C_5, eta and tau: none of them is measured."""
    gamma, steps = config.learner.gamma, config.env.episode_steps
    h, span, r_max = discounted_steps(gamma, steps), float(np.ptp(reward)), float(np.abs(reward).max())
    values: dict[str, Number] = {"c_1": (gamma + 2) * h * span, "c_45": 2 * h}
    about = f"gamma {gamma:g}, episodes of {steps} steps"
    origins = {
        "c_1": f"assumed: (gamma + 2) h times the rewards' range, {span:.3g}",
        "c_45": f"configured: C_4 = 2 h ({about})",
    }
    if dynamics:
        values["c_45"] += (discounted_index(gamma, steps) + h / (1 - gamma)) * r_max
        origins["c_45"] = f"configured: C_4 + C_5 ({about}; r_max {r_max:.3g} recorded)"
    if config.learner.algo == "npg":
        values |= {"eta": config.learner.table.eta, "tau": config.learner.table.entropy}
        origins |= {"eta": "configured: learner.table.eta", "tau": "configured: learner.table.entropy"}
    else:
        values |= {"eta": ASSUMED_ETA, "tau": ASSUMED_TAU}
        origins |= dict.fromkeys(("eta", "tau"), f"assumed: {config.learner.algo} has no such rate")
    return values, origins


def _remarks(config: RunConfig, *, has_holds: bool, moved: bool) -> tuple[str, ...]:
    physics = config.env.physics
    moving = [name for name in ("mass", "friction", "gravity") if getattr(physics, name).kind != "none"]
    remarks = [] if has_holds else ["the run never held: its holds are taken to begin with its windows"]
    if not moved:
        remarks.append("the reward did not change in any window: nothing speaks for a hold")
    if config.env.count > 1:
        remarks.append(f"what is recorded is of {env_names(config.env)[0]}, the first of {config.env.count}")
    if moving:
        remarks.append(f"the drift of {', '.join(moving)} is left out: its b_p is not known")
    return tuple(remarks)
