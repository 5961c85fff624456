"""A learner that is killed again and again knows what one that was never killed knows."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from learner import checkpoint, diary
from learner.diary import Acted, Published
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


def step(tick: int) -> Step:
    """Episodes of 50 ticks."""
    incarnation, begin = (7, 0) if tick < RESTART else (8, RESTART)
    episode_tick = (tick - begin) % 50
    reset = episode_tick == 0
    decision = b"" if reset else np.array([action_at(tick)], np.float32).tobytes()
    return Step(
        env="env0", incarnation=incarnation, seq=tick - begin, tick=tick, episode=(tick - begin) // 50,
        episode_tick=episode_tick, unit=tick // TICKS, due_ns=tick * TICK_NS, woke_ns=tick * TICK_NS,
        sent_ns=tick * TICK_NS, observation=np.array([state_at(tick)], np.float32).tobytes(),
        reward=0.0 if reset else reward_at(tick) + tick / 1000,
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
        self.run = RunDir.create(path, config)
        plan = msgspec.json.encode(lives).decode()
        command = [sys.executable, "-m", "tests.learner.arrivals_child", str(path), str(recorded), plan]
        root = Path(__file__).parents[2]
        done = subprocess.run(command, cwd=root, check=True, timeout=60, capture_output=True, text=True)
        self.ends: list[int] = json.loads(done.stdout)
        assert self.ends == [-9] * len(lives) + [0], done.stderr

    @property
    def replay(self) -> Replay:
        return open_replay(self.run.learner_dir / "replay", RUN.learner.replay_capacity, 1, 1)

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
    def acted(self) -> dict[tuple[int, int], int]:
        """Ticks by unit and version."""
        found: dict[tuple[int, int], int] = {}
        for entry in self.diary:
            if isinstance(entry, Acted):
                for version, ticks in entry.ticks.items():
                    found[entry.unit, version] = found.get((entry.unit, version), 0) + ticks
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


def killed_at_random(path: Path, recorded: Path, seed: int) -> Outcome:
    batches = msgspec.msgpack.decode(recorded.read_bytes(), type=Arrivals).batches
    return Outcome(path, recorded, random_lives(seed, len(batches)))


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
