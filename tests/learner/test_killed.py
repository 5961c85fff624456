"""A learner that is killed again and again knows what one that was never killed knows."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from learner import checkpoint, diary
from learner.diary import Acted, ActedIn, Published
from learner.replay import Replay, open_replay
from rtcore import channels
from rtcore.config import RunConfig
from rtcore.messages import Step, StepBatch
from rtcore.run_dir import RunDir
from tests.learner.arrivals_child import PUBLISHED, WITHIN, Arrivals, Life
from tests.learner.tabular.test_table_service import (
    CONFIG,
    SPEC,
    TICK_NS,
    TICKS,
    action_at,
    reward_at,
    state_at,
)

STEPS, BATCH, KILLS = 1200, 3, 20
RESTART = 700  # the tick at which the env server comes back
RUN = replace(CONFIG, learner=replace(CONFIG.learner, replay_capacity=500, checkpoint_s=5.0))
EACH = 300
# Three environments with so many ticks each, and room for all of their transitions: in which order
# those of several come is nobody's to say, and so neither is which are the oldest.
FLEET = replace(RUN, env=replace(RUN.env, count=3), learner=replace(RUN.learner, replay_capacity=STEPS))


def step(tick: int, env: int = 0, restart: int = RESTART) -> Step:
    """Episodes of 50 ticks."""
    incarnation, begin = (7, 0) if tick < restart else (8, restart)
    episode_tick = (tick - begin) % 50
    reset = episode_tick == 0
    decision = b"" if reset else np.array([action_at(tick)], np.float32).tobytes()
    return Step(
        env=f"env{env}", incarnation=incarnation, seq=tick - begin, tick=tick, episode=(tick - begin) // 50,
        episode_tick=episode_tick, unit=tick // TICKS, due_ns=tick * TICK_NS, woke_ns=tick * TICK_NS,
        sent_ns=tick * TICK_NS, observation=np.array([state_at(tick)], np.float32).tobytes(),
        reward=0.0 if reset else reward_at(tick) + tick / 1000 + 100 * env,
        terminated=False, truncated=episode_tick == 49,
        action=decision, decision=decision, answered_tick=tick - 1, policy_version=tick // 100, missed=False,
        fallback="", cause="", skipped=0, loop_ns=0, reaction_ns=-1, drift=0.0, position=b"",
    )  # fmt: skip


def arrivals(path: Path) -> Path:
    """In batches of 3 ticks; of each 10, two change places, one comes twice, and one in 70 never comes."""
    batches = []
    for begin, end in ((0, RESTART), (RESTART, STEPS)):
        for first in range(begin, end, BATCH):
            steps = [step(tick) for tick in range(first, min(first + BATCH, end))]
            batches.append((first * TICK_NS, StepBatch(steps=steps)))
    for index in range(4, len(batches) - 1, 10):
        (early, one), (late, other) = batches[index : index + 2]
        batches[index : index + 2] = [(early, other), (late, one)]
    del batches[50::70]
    for index in range(9, len(batches), 10):
        at_ns, batch = batches[index - 1]
        batches.insert(index, (at_ns, batch))
    path.write_bytes(msgspec.msgpack.encode(Arrivals(SPEC, batches)))
    return path


def fleet_arrivals(path: Path) -> Path:
    """In batches of 3 ticks, of the three environments in turn, the second of which comes back. Of each 10
    one changes places with the next of its environment, another one comes twice, and one in 70 never."""
    batches: list[tuple[int, StepBatch]] = []
    for first in range(0, EACH, BATCH):
        for env in range(3):
            restart = 201 if env == 1 else STEPS
            steps = [step(tick, env, restart) for tick in range(first, min(first + BATCH, EACH))]
            batches.append((first * TICK_NS + env, StepBatch(steps=steps)))
    for index in range(4, len(batches) - 3, 10):
        (early, one), (late, other) = batches[index], batches[index + 3]  # of the same environment
        batches[index], batches[index + 3] = (early, other), (late, one)
    del batches[50::70]
    for index in range(9, len(batches), 10):
        batches.insert(index, batches[index - 1])
    path.write_bytes(msgspec.msgpack.encode(Arrivals(SPEC, batches)))
    return path


def random_lives(seed: int, arrived: int) -> list[Life]:
    """`KILLS` of them: at any line of the learner's code, within a mark, at any instant."""
    rng = np.random.default_rng(seed)
    ats = np.sort(rng.choice((arrived - WITHIN - 3) // 12, KILLS, replace=False)) * 12 + 2
    ways = rng.permutation(["line"] * 11 + ["mark"] * 5 + ["timer"] * 4)
    counts = {"line": 1500, "mark": 12, "timer": 30_000}
    return [
        Life(at=int(at), way=str(way), count=1 + int(rng.integers(counts[way])), cut=int(rng.integers(300)))
        for at, way in zip(ats, ways, strict=True)
    ]


class Outcome:
    """What a run left behind."""

    def __init__(self, path: Path, recorded: Path, lives: list[Life], config: RunConfig = RUN) -> None:
        self.run, self.config = RunDir.create(path, config), config
        plan = msgspec.json.encode(lives).decode()
        command = [sys.executable, "-m", "tests.learner.arrivals_child", str(path), str(recorded), plan]
        root = Path(__file__).parents[2]
        done = subprocess.run(command, cwd=root, check=True, timeout=60, capture_output=True, text=True)
        self.ends: list[int] = json.loads(done.stdout)
        assert self.ends == [-9] * len(lives) + [0], done.stderr

    @property
    def replay(self) -> Replay:
        capacity, envs = self.config.learner.replay_capacity, self.config.env.count
        return open_replay(self.run.learner_dir / "replay", capacity, 1, 1, envs=envs)

    @property
    def rows(self) -> list[list[tuple[float, ...]]]:
        """Of each environment, in order: reward, observations, action."""
        rows, found = self.replay.read(0, STEPS), [[], [], []]  # type: ignore[var-annotated]
        for index, reward in enumerate(rows.reward.tolist()):
            ends = float(rows.observation[index, 0]), float(rows.next_observation[index, 0])
            found[int(reward // 100)].append((reward, *ends, float(rows.action[index, 0])))
        return found

    @property
    def q(self) -> list[list[float]]:
        table: list[list[float]] = checkpoint.load(self.run.learner_dir / "checkpoint").tensors["q"].tolist()
        return table

    def counted(self, name: str) -> int:
        """Over all lives."""
        lives = self.run.read_final_stats()
        return sum(stats.counters.get(name, 0) for stats in lives if stats.process == channels.LEARNER)

    @property
    def published(self) -> list[tuple[int, int, int, str]]:
        lines = (self.run.path / PUBLISHED).read_text().split("\n")[:-1]
        return [(int(v), int(m), int(g), digest) for v, m, g, digest in (line.split() for line in lines)]

    @property
    def diary(self) -> list[diary.Entry]:
        return diary.read(self.run.learner_dir / diary.NAME).entries

    @property
    def acted(self) -> Counter[tuple[str, int, int]]:
        """Ticks by environment, unit and version."""
        found: Counter[tuple[str, int, int]] = Counter()
        for entry in self.diary:
            if isinstance(entry, Acted):
                env = entry.env if isinstance(entry, ActedIn) else ""
                for version, ticks in entry.ticks.items():
                    found[env, entry.unit, version] += ticks
        return found


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return arrivals(tmp_path_factory.mktemp("arrivals") / "arrivals.msgpack")


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory, recorded: Path) -> Outcome:
    return Outcome(tmp_path_factory.mktemp("straight") / "run", recorded, [])


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory, recorded: Path) -> Outcome:
    return killed_at_random(tmp_path_factory.mktemp("killed") / "run", recorded, seed=1)


def killed_at_random(path: Path, recorded: Path, seed: int, config: RunConfig = RUN) -> Outcome:
    batches = msgspec.msgpack.decode(recorded.read_bytes(), type=Arrivals).batches
    return Outcome(path, recorded, random_lives(seed, len(batches)), config)


def test_killed_20_times_it_ends_with_the_same(killed: Outcome, straight: Outcome) -> None:
    assert killed.replay.content_hash() == straight.replay.content_hash()
    assert killed.q == straight.q
    assert killed.acted == straight.acted
    for name in ("learned", "gaps", "broken"):
        assert killed.counted(name) == straight.counted(name), name
    assert killed.counted("learned") == killed.replay.added


def test_killed_20_times_no_version_and_no_iterate_comes_twice(killed: Outcome, straight: Outcome) -> None:
    versions = [version for version, *_ in killed.published]
    assert versions == sorted(versions)
    fresh = set(killed.published)  # a learner that begins repeats the newest, as it was
    assert len({version for version, *_ in fresh}) == len(fresh)
    assert len({(window, g) for _, window, g, _ in fresh}) == len(fresh)
    told = {(one.version, one.window, one.iterate) for one in killed.diary if isinstance(one, Published)}
    assert {one[:3] for one in fresh} <= told
    assert killed.counted("published_in_hold") == 0
    assert len(fresh) >= len(straight.published) - KILLS


def test_killed_20_times_it_has_learned_the_same_from_each_environment_of_a_fleet(tmp_path: Path) -> None:
    """It takes what comes as it comes, so only the transitions of each one have an order."""
    recorded = fleet_arrivals(tmp_path / "arrivals.msgpack")
    straight = Outcome(tmp_path / "straight", recorded, [], FLEET)
    killed = killed_at_random(tmp_path / "killed", recorded, 1, FLEET)
    assert killed.rows == straight.rows
    assert killed.acted == straight.acted
    envs = ("env0", "env1", "env2")
    for name in ("learned", "gaps", "broken"):
        for env in envs:
            assert killed.counted(f"{name}.{env}") == straight.counted(f"{name}.{env}"), (name, env)
            assert name == "broken" or straight.counted(f"{name}.{env}") > 0
        assert killed.counted(name) == sum(killed.counted(f"{name}.{env}") for env in envs)
    assert [killed.counted(f"learned.{env}") for env in envs] == [len(rows) for rows in killed.rows]
