"""A real env server whose agent is killed, and both of them stopped: what acts, and what is counted."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import get_args

import msgspec
import numpy as np
import pytest

from env_server.worlds.registry import resolve
from rtcore.channels import AGENT, ENV_SERVER
from rtcore.config import AgentConfig, EnvConfig, MissPolicy, RecorderConfig, RunConfig
from rtcore.files import write_atomic
from rtcore.messages import Architecture, Policy, Step
from tests.agent_service.rig import policy
from tests.system.cast import Cast, cast

TICK_NS = 10_000_000
HOLD_TICKS = 12
ENV = EnvConfig(id="pointmass", hz=100.0, episode_steps=500, start_wait_s=5.0, hold_ticks=HOLD_TICKS)
CONFIG = RunConfig(env=resolve(ENV), agent=AgentConfig(rt="off"), recorder=RecorderConfig(record=False))
ARCHITECTURE = Architecture(kind="tanh_gaussian_mlp", observation_dim=1, action_dim=1, hidden=[4])
FALLBACKS: tuple[MissPolicy, ...] = get_args(MissPolicy)
HELD = np.tanh(np.float32(0.5))  # the policy's action, whatever is observed; the bounds are -1 and 1


@contextmanager
def attended(path: Path, on_miss: MissPolicy) -> Iterator[Cast]:
    """A world whose agent has answered for a while, by a published policy, beside no learner."""
    env = replace(CONFIG.env, on_miss=on_miss, start_wait_s=0.0)
    with cast(path, replace(CONFIG, env=env)) as on:
        write_atomic(on.run.policy_path, msgspec.msgpack.encode(published(3)))
        on.start(AGENT, ENV_SERVER)
        on.watch_until(lambda: len(answered(on.steps)) >= 20)
        yield on


def published(version: int) -> Policy:
    return policy(version, mean_bias=0.5, architecture=ARCHITECTURE)


def answered(steps: list[Step]) -> list[Step]:
    return [step for step in steps if step.episode_tick > 0 and not step.missed]


def fallbacks(steps: list[Step]) -> list[str]:
    """What acted, checked against the action itself."""
    for step in steps:
        wanted = HELD if step.fallback == "hold" else 0.0
        np.testing.assert_allclose(np.frombuffer(step.action, "<f4"), wanted, rtol=1e-6)
        assert step.policy_version == (3 if step.fallback == "hold" else -1)
    return [step.fallback for step in steps]


@dataclass(frozen=True)
class Unattended:
    """The steps of a world whose agent was killed and came back with a newer policy."""

    steps: list[Step]
    killed_ns: int
    began_ns: int


def lose_the_agent(path: Path, on_miss: MissPolicy) -> Unattended:
    with attended(path, on_miss) as on:
        killed_ns = on.send(AGENT, signal.SIGKILL)
        on.watch(0.4)
        write_atomic(on.run.policy_path, msgspec.msgpack.encode(published(4)))
        began_ns = on.start(AGENT)
        on.watch_until(lambda: any(step.due_ns > began_ns for step in answered(on.steps)))
        return Unattended(on.steps, killed_ns, began_ns)


@pytest.fixture(scope="module")
def worlds(tmp_path_factory: pytest.TempPathFactory) -> dict[MissPolicy, Future[Unattended]]:
    """One for each fallback, all at once: they mostly wait."""
    with ThreadPoolExecutor(len(FALLBACKS)) as pool:
        return {
            name: pool.submit(lose_the_agent, tmp_path_factory.mktemp(name) / "run", name)
            for name in FALLBACKS
        }


@pytest.mark.parametrize("on_miss", FALLBACKS)
def test_without_its_agent_the_world_goes_on_with_the_declared_fallback(
    worlds: dict[MissPolicy, Future[Unattended]], on_miss: MissPolicy
) -> None:
    world = worlds[on_miss].result()
    steps, killed_ns, began_ns = world.steps, world.killed_ns, world.began_ns
    first = next(step for step in answered(steps) if step.due_ns > began_ns)
    alone = [step for step in steps if step.missed and killed_ns < step.due_ns < first.due_ns]
    assert sum(1 + step.skipped for step in alone) >= 35
    assert {step.cause for step in alone if step.due_ns > killed_ns + TICK_NS} == {"agent_absent"}
    assert not [step for step in answered(steps) if killed_ns + TICK_NS < step.due_ns < began_ns]
    found = fallbacks(alone)
    before = [step for step in steps if step.due_ns <= killed_ns]
    fallbacks([step for step in before if step.missed])
    in_a_row = sum(1 for _ in takewhile(lambda step: step.missed, reversed(before)))  # held already
    held = {"hold": len(found), "neutral": 0, "hold_then_neutral": max(0, HOLD_TICKS - in_a_row)}[on_miss]
    assert found == ["hold"] * held + ["neutral"] * (len(found) - held)
    assert first.policy_version == 4  # the new agent's first answer, with the newest policy and never pi_0


def test_a_stopped_process_catches_up_with_nothing(tmp_path: Path) -> None:
    """The env server and then the agent stands still for 0.3 s, which is 30 deadlines."""
    with attended(tmp_path / "run", "hold") as on:
        env_stopped = on.stop_for(ENV_SERVER, 0.3)
        on.watch(0.4)
        agent_stopped = on.stop_for(AGENT, 0.3)
        on.watch(0.4)
        assert on.end(AGENT) == 0
        (agent,) = [one for one in on.run.read_final_stats() if one.process == AGENT]
    for before, step in zip(on.steps, on.steps[1:], strict=False):
        assert (step.tick - before.tick, step.seq - before.seq) == (1 + step.skipped, 1)
        assert step.due_ns - before.due_ns == (1 + step.skipped) * TICK_NS
        assert step.woke_ns >= step.due_ns  # no tick comes early to make up for one that was lost
    _check_env_stop(on.steps, *env_stopped)
    _check_agent_stop(on.steps, *agent_stopped)
    count = Counter(agent.counters)
    assert count["actions"] + count["observations.superseded"] == count["observations"]
    assert count["actions"] <= len(on.steps) + 10  # those after the last batch that was read
    assert count["observations.superseded"] >= 20  # of the 30 only the newest ones are answered


def _check_env_stop(steps: list[Step], stopped_ns: int, going_on_ns: int) -> None:
    """Deadlines inside the stop are skipped at once."""
    assert not [step for step in steps if stopped_ns + TICK_NS < step.woke_ns < going_on_ns]
    resumed = next(step for step in steps if step.woke_ns > going_on_ns)
    assert resumed.skipped >= 27


def _check_agent_stop(steps: list[Step], stopped_ns: int, going_on_ns: int) -> None:
    """The world goes on meanwhile."""
    about = [step for step in steps if stopped_ns + 2 * TICK_NS < step.due_ns < going_on_ns]
    assert sum(1 + step.skipped for step in about) >= 25
    assert all(step.missed for step in about if step.episode_tick > 0)
    assert Counter(step.cause for step in about).most_common(1)[0][0] == "agent_stalled"
    later = [step for step in steps if step.due_ns > going_on_ns + 10 * TICK_NS]
    assert len(answered(later)) >= len(later) // 2  # all but for a busy machine
