"""A fleet of three from the command line, real processes over real Zenoh, one agent killed on the way."""

from __future__ import annotations

import subprocess
import time
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from launcher.chaos.faults import Lives
from launcher.summary import discrepancies
from launcher.totals import Totals, add_up
from recorder.reading import columns
from rtcore import cast, channels
from rtcore.config import EnvConfig, RunConfig
from rtcore.messages import Stats
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import open_bus
from tests.system.test_processes import SMALL, finish, running, summary_of, tenuto

pytestmark = pytest.mark.timeout(
    120
)  # 7 s of run time, and what a busy machine takes to start eight processes

NAMES = cast.names(RunConfig(env=EnvConfig(count=3)))
ENVS = ("env0", "env1", "env2")
KILLED = "agent_service.1"
HZ, DURATION_S = 50, 7


@dataclass(frozen=True)
class Story:
    """What the run left behind.

    Attributes:
        summary: its summary.
        stats: the ledgers of each process's lives.
        begins: the first observation of each environment.
        status: what `tenuto status` said while it went on.
        output: what the run said.
    """

    run: Path
    summary: dict[str, Any]
    stats: dict[str, list[Stats]]
    begins: dict[str, bytes]
    status: str
    output: str

    def totals(self, process: str) -> Totals:
        return add_up(self.stats[process])


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Story:
    """Seven seconds; after a second and a half an agent is killed."""
    run = tmp_path_factory.mktemp("fleet") / "run"
    arguments = ("--env.count", "3", "--duration-s", str(DURATION_S), "--run-dir", str(run))
    with running("run", "pointmass", *SMALL, *arguments) as process:
        wait_for_ticks(run, process)
        time.sleep(1.5)
        victim = Lives(run).find(KILLED)
        assert victim is not None
        victim.suffer("kill")
        victim.release()
        status = subprocess.run(
            tenuto("status", "--run-dir", str(run)), capture_output=True, text=True, timeout=30, check=False
        )
        begins = first_observations(RunDir.open(run))
        output = finish(process, 60)
        assert process.returncode == 0, output
    stats: dict[str, list[Stats]] = {}
    for one in RunDir.open(run).read_final_stats():
        stats.setdefault(one.process, []).append(one)
    return Story(run, summary_of(run), stats, begins, status.stdout, output)


def wait_for_ticks(run: Path, process: subprocess.Popen[str], timeout_s: float = 90.0) -> None:
    """Until all env servers say that they tick."""
    logs = [run / "logs" / f"env_server.{i}.jsonl" for i in range(len(ENVS))]
    deadline = time.monotonic() + timeout_s
    while not all(log.exists() and " Hz" in log.read_text() for log in logs):
        assert process.poll() is None, finish(process, 5)
        assert time.monotonic() < deadline, f"no tick within {timeout_s} s"
        time.sleep(0.05)


def first_observations(run: RunDir, limit_s: float = 20.0) -> dict[str, bytes]:
    """As a late reader of all logs gets them, by environment."""
    found: dict[str, bytes] = {}
    deadline = time.monotonic() + limit_s
    with open_bus("client", run.run_name, run.socket_dir(), clock=MonotonicClock(), peers=NAMES) as bus:
        log = bus.queue(channels.LOG, "*")
        while len(found) < len(ENVS) and time.monotonic() < deadline:
            log.wait(0.1)
            steps = [step for received in log.drain() for step in received.message.steps]
            found |= {step.env: step.observation for step in steps if step.seq == 0}
    return found


def test_every_environment_reconciles_and_so_do_the_totals(story: Story) -> None:
    assert discrepancies(story.summary) == []
    assert "reconcile" in story.output
    assert (story.summary["ended"], story.summary["env_count"]) == ("duration", 3)
    assert list(story.summary["envs"]) == list(ENVS)
    for row in story.summary["envs"].values():
        assert row["ticks"] + row["skipped"] == HZ * DURATION_S
        assert row["lost"] == 0 and row["learned"] == row["produced"] > 0
        assert row["adopted"] > 0
    assert story.summary["learner"]["gradient_steps"] > 0
    assert story.summary["recorder"]["dropped"] == story.summary["messages"]["rejected"] == 0


def test_one_learner_learned_from_all(story: Story) -> None:
    learner = story.totals("learner").counters
    for i, name in enumerate(ENVS):
        produced = story.totals(f"env_server.{i}").counters["produced"]
        assert learner[f"learned.{name}"] == produced > 0
    assert learner["learned"] == sum(learner[f"learned.{name}"] for name in ENVS)


def test_the_killed_agent_alone_lived_twice_and_its_environment_alone_missed_it(story: Story) -> None:
    assert {name: len(story.stats[name]) for name in NAMES} == {name: 1 + (name == KILLED) for name in NAMES}
    assert story.summary["restarts"] == {"env_server": 0, "agent_service": 1, "learner": 0, "recorder": 0}
    assert [row["restarts"]["agent_service"] for row in story.summary["envs"].values()] == [0, 1, 0]
    assert [(one["process"], one["what"]) for one in story.summary["supervision"]] == [
        (KILLED, "died"), (KILLED, "restarted"),
    ]  # fmt: skip
    absent = [story.totals(f"env_server.{i}").counters["missed.agent_absent"] for i in range(3)]
    assert absent[0] == absent[2] == 0
    assert 0 < absent[1] < HZ * DURATION_S
    again = max(story.stats[KILLED], key=lambda life: life.incarnation)
    assert again.counters["actions"] > 0


def test_status_lists_every_process(story: Story) -> None:
    listed = [line.split()[0] for line in story.status.splitlines() if line.split()[0] in NAMES]
    assert listed == list(NAMES)


def test_the_recording_has_every_environments_ticks(story: Story) -> None:
    recording = story.run / "recording.rrd"
    for name, row in story.summary["envs"].items():
        ticks, _ = columns(recording, f"/{name}/env/reward")
        assert len(ticks) == len(set(ticks.tolist())) == row["ticks"]


def test_they_are_the_same_world_from_other_beginnings(story: Story) -> None:
    recording = story.run / "recording.rrd"
    drifts = [drift(recording, name) for name in ENVS]
    for one, other in combinations(drifts, 2):
        common = sorted(one.keys() & other.keys())
        assert len(common) > HZ
        assert [one[tick] for tick in common] == [other[tick] for tick in common]
    assert len(set(drifts[0].values())) > 1
    assert len(set(story.begins.values())) == len(ENVS)
    first = [min(story.stats[f"env_server.{i}"][0].returns, key=lambda one: one.episode) for i in range(3)]
    assert len({one.value for one in first}) == 3


def drift(recording: Path, name: str) -> dict[int, float]:
    """The target by tick; how fast the world followed it, beside it in the recording, is its own."""
    ticks, values = columns(recording, f"/{name}/env/drift")
    return dict(zip(ticks.tolist(), values[:, 0].tolist(), strict=True))
