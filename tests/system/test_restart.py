"""Env server and agent killed beside those that go on: by the log, the replay and the recording they left."""

from __future__ import annotations

import math
import signal
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from env_server.worlds.registry import resolve
from launcher.summary import discrepancies, summarise
from launcher.totals import add_up
from learner import resume
from learner.replay import open_replay
from recorder.reading import columns
from rtcore import epoch
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER
from rtcore.config import (
    AgentConfig,
    DriftConfig,
    EnvConfig,
    LearnerConfig,
    RecorderConfig,
    RunConfig,
    ScheduleConfig,
)
from rtcore.messages import Stats, Step
from rtcore.run_dir import RunDir
from tests.system.cast import cast

pytestmark = pytest.mark.timeout(120)  # others are played beside it

TICK_NS, TICKS = 10_000_000, 700
DRIFT = DriftConfig(kind="sine", amplitude=1.0, omega=0.7)
ENV = EnvConfig(id="pointmass", hz=100.0, episode_steps=33, unit_s=0.1, start_wait_s=30.0, drift=DRIFT)
CONFIG = RunConfig(
    duration_s=TICKS / 100,
    env=resolve(ENV),
    agent=AgentConfig(rt="off"),
    learner=LearnerConfig(
        learning_starts=20, hidden=(8, 8), batch=8, utd=0.1, replay_capacity=10_000,
        schedule=ScheduleConfig(l_f=4, gamma_f=1.0),
    ),
    recorder=RecorderConfig(record=True),
)  # fmt: skip


@dataclass(frozen=True)
class Story:
    """A finished run whose env server was killed, and then its agent; instants on the monotonic clock."""

    run: RunDir
    steps: list[Step]  # as a witness got them
    stats: dict[str, list[Stats]]
    env_killed_ns: int
    agent_killed_ns: int
    agent_began_ns: int

    def lives(self) -> list[list[Step]]:
        """The steps of each incarnation of the env server."""
        incarnations = sorted({step.incarnation for step in self.steps})
        return [[step for step in self.steps if step.incarnation == one] for one in incarnations]

    def counted(self, process: str, name: str) -> list[int]:
        """A counter, of each life."""
        return [life.counters.get(name, 0) for life in self.stats[process]]


def play(home: Path) -> Story:
    with cast(home / "run", CONFIG) as on:
        on.start(*PROCESSES)
        on.watch_until(lambda: len(on.steps) >= 150)
        env_killed_ns = on.send(ENV_SERVER, signal.SIGKILL)
        on.watch(0.25)
        on.start(ENV_SERVER)
        on.watch_until(lambda: sum(s.due_ns > env_killed_ns and is_answered(s) for s in on.steps) >= 50)
        agent_killed_ns = on.send(AGENT, signal.SIGKILL)
        on.watch(0.4)
        agent_began_ns = on.start(AGENT)
        assert on.end(ENV_SERVER) == 0
        on.watch(0.3)
        assert [on.end(process) for process in (AGENT, LEARNER, RECORDER)] == [0, 0, 0]
        stats: dict[str, list[Stats]] = {}
        for life in on.run.read_final_stats():
            stats.setdefault(life.process, []).append(life)
        return Story(on.run, on.steps, stats, env_killed_ns, agent_killed_ns, agent_began_ns)


@pytest.fixture(scope="module")
def story(played: Callable[[str], Any]) -> Story:
    found: Story = played("test_restart")
    return found


def test_the_world_goes_on_by_its_first_clock_to_its_original_end(story: Story) -> None:
    beginning = epoch.read(story.run.epoch_path)
    assert beginning is not None and beginning.lives == 2
    for step in story.steps:
        assert step.due_ns == beginning.t0_ns + step.tick * TICK_NS
        assert step.unit == step.tick // 10
        assert math.isclose(step.drift, math.sin(0.7 * step.unit), abs_tol=1e-9)
    first, second = story.lives()
    assert first[-1].due_ns < story.env_killed_ns < second[0].due_ns
    assert second[0].episode > first[-1].episode and second[0].episode_tick == 0
    assert second[-1].tick < TICKS
    env = add_up(story.stats[ENV_SERVER]).counters
    assert env["ticks"] + env["skipped"] + env["down"] == TICKS
    assert env["down"] >= 25  # of 0.25 s, and its start


def test_no_transition_joins_two_incarnations_and_what_was_lost_is_exact(story: Story) -> None:
    first, second = story.lives()
    directory = story.run.learner_dir / resume.REPLAY_DIR
    dim, capacity = len(first[0].observation) // 4, CONFIG.learner.replay_capacity
    replay = open_replay(directory, capacity, dim, len(first[1].action) // 4)
    held = replay.read(0, capacity)
    rows = [
        (before.tobytes(), after.tobytes(), int(unit))
        for before, after, unit in zip(held.observation, held.next_observation, held.unit, strict=True)
    ]
    produced = story.counted(ENV_SERVER, "produced")
    of_first, of_second = rows[: -produced[1]], rows[-produced[1] :]
    # Nothing of the second life is lost; of the first, what was not sent yet when it was killed.
    assert of_second == pairs(second)
    lost = produced[0] - len(of_first)
    assert 0 <= lost < 75  # 50 ms of it, and what the busy machine kept from being sent
    seen = pairs(first)
    common = min(len(seen), len(of_first))  # a last batch may have reached one reader alone
    assert of_first[:common] == seen[:common] and common > produced[0] - 75
    assert not {(first[-1].observation, step.observation) for step in second} & {row[:2] for row in rows}
    assert sum(story.counted(LEARNER, "learned")) == len(rows)
    summary = summarise(CONFIG, "run", story.stats, wall_s=0.0, restarts={})
    assert summary["transitions"]["lost"] == lost
    assert discrepancies(summary) == []


def pairs(steps: list[Step]) -> list[tuple[bytes, bytes, int]]:
    """The transitions in a life's steps: each step that is no reset ends one."""
    assert [step.seq for step in steps] == list(range(len(steps)))
    return [
        (before.observation, after.observation, after.unit)
        for before, after in pairwise(steps)
        if after.episode_tick > 0
    ]


def test_the_others_go_on_with_the_new_incarnation(story: Story) -> None:
    lives = {process: len(stats) for process, stats in story.stats.items()}
    assert lives == {ENV_SERVER: 2, AGENT: 2, LEARNER: 1, RECORDER: 1}
    _, second = story.lives()
    answered = [step for step in second if step.due_ns < story.agent_killed_ns and not step.missed]
    assert len([step for step in answered if step.episode_tick > 0]) >= 50
    recorded = columns(story.run.recording_path, "/env/reward")[0].tolist()
    assert len(recorded) == len(set(recorded))
    assert {step.tick for step in second} <= set(recorded)


def test_the_new_agent_begins_with_the_newest_policy(story: Story) -> None:
    versions = [(step.due_ns, step.policy_version) for step in story.steps if is_answered(step)]
    assert [version for _, version in versions] == sorted(version for _, version in versions)
    before = [version for due_ns, version in versions if due_ns < story.agent_killed_ns]
    after = [version for due_ns, version in versions if due_ns > story.agent_began_ns]
    assert after[0] >= before[-1] > 0
    assert sum(story.counted(AGENT, "policies.past")) == 0


def test_without_an_agent_every_deadline_is_missed_and_said_to_be(story: Story) -> None:
    first_answer_ns = min(s.due_ns for s in story.steps if is_answered(s) and s.due_ns > story.agent_began_ns)
    alone = [
        step
        for step in story.steps
        if story.agent_killed_ns + TICK_NS < step.due_ns < first_answer_ns and step.episode_tick > 0
    ]
    assert len(alone) > 30
    assert all(step.missed for step in alone)
    assert Counter(step.cause for step in alone).most_common(1)[0] == ("agent_absent", len(alone))


def is_answered(step: Step) -> bool:
    return step.episode_tick > 0 and not step.missed
