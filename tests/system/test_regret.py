"""The regret in a summary against one that is computed from the steps themselves, the slow way."""

from __future__ import annotations

from collections import defaultdict
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest

from env_server.worlds.registry import resolve
from experiments.finite_presets import chain
from experiments.presets import pointmass
from launcher import regret
from launcher.sim import Simulation, simulate
from rtcore import channels
from rtcore.config import RunConfig, ScheduleConfig
from rtcore.lifecycle import Stop
from rtcore.messages import Policy, Step
from rtcore.run_dir import RunDir
from rtcore.weights import unpack

GAMMA = 0.9


def short() -> RunConfig:
    """Ten units of 50 ticks a window: 3 of updates, 2 of hold; 20 units in all."""
    base = chain()
    env = resolve(replace(base.env, unit_s=0.25))
    learner = replace(base.learner, schedule=ScheduleConfig(l_f=5, gamma_f=0.6))
    return replace(
        base, duration_s=5.0, env=env, learner=learner, recorder=replace(base.recorder, record=False)
    )


@pytest.fixture(scope="module")
def lived(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDir, list[Step], list[Policy]]:
    """A run in virtual time, and all that a witness on the bus has seen."""
    config = short()
    run_dir = RunDir.create(tmp_path_factory.mktemp("regret") / "run", config)
    with ExitStack() as stack:
        simulation = Simulation(config, run_dir, stack)
        witness = simulation._hub.bus("witness", simulation._clock)
        stack.callback(witness.close)
        log = witness.queue(channels.LOG, "*", capacity=100_000)
        policies = witness.queue(channels.POLICY, capacity=100_000)
        simulation.run(Stop(), lambda _: None)
        simulation.finish()
        steps = [step for batch in log.drain() for step in batch.message.steps]
        return run_dir, steps, [one.message for one in policies.drain()]


def value(step_drift: float, policy: np.ndarray | None) -> np.ndarray:
    """V of the chain by value iteration, action by action; without a policy, of the best one."""
    share, last = (1 + step_drift) / 2, 4
    v = np.zeros(5)
    for _ in range(450):  # 0.9^450 is 3e-21
        q = np.array(
            [
                [
                    (share if s == 0 else 1 - share if s == last else 0.0)
                    + GAMMA * v[min(max(s + a, 0), last)]
                    for a in (-1, 1)
                ]
                for s in range(5)
            ]
        )
        v = q.max(1) if policy is None else (policy * q).sum(1)
    return v


def test_the_summarys_regret_is_that_of_the_steps(lived: tuple[RunDir, list[Step], list[Policy]]) -> None:
    run_dir, steps, published = lived
    tables: dict[int, Any] = {one.version: unpack(one.weights)["probability"] for one in published}
    tables[0] = np.full((5, 2), 0.5)
    known: dict[tuple[int, int], np.ndarray] = {}
    by_unit: dict[int, list[np.ndarray]] = defaultdict(list)
    for step in steps:
        if step.episode_tick == 0:
            continue
        at = (step.unit, step.policy_version)
        if at not in known:
            table = tables[step.policy_version].astype(np.float64)
            known[at] = value(step.drift, None) - value(step.drift, table / table.sum(1, keepdims=True))
        by_unit[step.unit].append(known[at])
    assert len({version for _, version in known}) > 8
    found = regret.of_run(short(), run_dir)["regret"]
    assert (found["units"], found["ticks"], found["left_out_ticks"]) == (
        20,
        sum(map(len, by_unit.values())),
        0,
    )
    start = {unit: fmean(gap.mean() for gap in gaps) for unit, gaps in by_unit.items()}
    worst = {unit: fmean(gap.max() for gap in gaps) for unit, gaps in by_unit.items()}
    for lost, told in ((start, found), (worst, found["worst_state"])):
        update = sum(one for unit, one in lost.items() if unit % 5 < 3)
        hold = sum(one for unit, one in lost.items() if unit % 5 >= 3)
        assert told["update"] == pytest.approx(update, abs=1e-9)
        assert told["hold"] == pytest.approx(hold, abs=1e-9)
        assert told["total"] == pytest.approx(update + hold, abs=1e-9)
        assert told["per_unit"] == pytest.approx((update + hold) / 20, abs=1e-9)


def test_its_windows_stay_within_their_bounds(lived: tuple[RunDir, list[Step], list[Policy]]) -> None:
    found = regret.of_run(short(), lived[0])["regret"]["bounds"]
    assert (found["windows"], found["units"]) == (3, 15)  # the fourth does not end
    assert 0 < found["iterates_worst_state"]["total"] <= min(found["gibbs"], found["proven"])
    assert found["printed"] > 0 and found["repaired"] > 0


def test_a_continuous_world_has_none(tmp_path: Path) -> None:
    base = pointmass()
    config = replace(
        base, duration_s=1.0, env=resolve(base.env), recorder=replace(base.recorder, record=False)
    )
    run_dir = RunDir.create(tmp_path / "run", config)
    simulate(config, run_dir, Stop(), lambda _: None)
    found = regret.of_run(config, run_dir)
    assert found == {"regret": None, "regret_missing": "V* is not known in a continuous world"}
    assert not (run_dir.learner_dir / "diary.msgpack").exists()
