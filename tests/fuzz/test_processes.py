"""A rogue beside a run of real processes over real Zenoh: nobody dies, the world keeps its pace, all counts.

The rogue is a process of its own, the last in the queue for a core, and sends 2000 messages a second: this is
about what a message can do to whoever receives it. That a program that computes as much as it likes, or sends
faster than anybody can receive, slows down a machine of two cores is no finding. And the env server's pace is
held against that of the same run in the seconds before, since other work may stop this machine in both.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from launcher.summary import discrepancies
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER, TABLE
from rtcore.run_dir import RunDir
from tests.rtcore.bus_samples import eventually
from tests.system.test_processes import SMALL, finish, order, running, summary_of

PER_SECOND = 2000
DECLARED = 256  # declarations wait until one is wanted, so many of them


@dataclass(frozen=True)
class Attacked:
    """A run at 50 Hz that was flooded for some seconds, by its own records, and what the rogue told."""

    path: Path
    output: str
    code: int
    told: dict[str, Any]
    final: dict[str, Counter[str]]  # counters of each process's only life

    def rejected(self, process: str, channel: str) -> int:
        return self.final[process][f"messages.rejected.{channel}"]


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory, flood: int) -> Attacked:
    run = tmp_path_factory.mktemp("attacked") / "run"
    rogue = [sys.executable, "-m", "tests.fuzz.flooder", str(run)]
    with running("run", "pointmass", *SMALL, "--duration-s", "3600", "--run-dir", str(run)) as process:
        assert eventually((run / "run.toml").exists, 20)
        spoken = subprocess.run(
            ["nice", "-n", "19", *rogue, "--messages", str(flood), "--per-second", str(PER_SECOND)],
            capture_output=True, text=True, timeout=90 + 3 * flood / PER_SECOND, check=False,
        )  # fmt: skip
        assert spoken.returncode == 0, spoken.stderr
        order(run, "stop")  # and not by an interrupt, after which a busy machine has too little time
        output = finish(process, 40)
    told = json.loads(spoken.stdout)
    sys.stdout.write(f"{json.dumps(told, indent=1)}\n")
    lives = RunDir.open(run).read_final_stats()
    assert Counter(life.process for life in lives) == Counter(PROCESSES)
    final = {life.process: Counter(life.counters) for life in lives if life.final}
    return Attacked(run, output, process.returncode, told, final)


def test_nobody_dies_and_nothing_that_was_sent_has_an_effect(attacked: Attacked, flood: int) -> None:
    assert attacked.code == 0, attacked.output
    assert set(attacked.final) == set(PROCESSES)
    summary = summary_of(attacked.path)
    assert (summary["ended"], summary["supervision"], summary["forced"]) == ("stopped", [], [])
    assert discrepancies(summary) == []
    assert summary["transitions"]["lost"] == 0
    assert summary["policies"]["foreign"] == 0
    assert sum(attacked.told["sent"].values()) >= flood
    lines = sum(path.read_text().count("\n") for path in attacked.path.glob("logs/*.jsonl"))
    assert lines < 100 + flood / PER_SECOND * 3  # each of 13 readers says one in ten seconds


def test_the_world_keeps_its_pace(attacked: Attacked) -> None:
    quiet, noisy = attacked.told["quiet"], attacked.told["attacked"]
    for stretch in (quiet, noisy):
        assert stretch["ticks"] + stretch["skipped"] == stretch["deadlines"]
    assert noisy["ticks"] > 50
    assert noisy["skipped"] <= quiet["skipped"]  # none, and so no tick was late by a period


def test_each_refused_message_is_counted_by_each_who_got_it(attacked: Attacked) -> None:
    sent, refused = attacked.told["sent"], attacked.told["refused"]
    assert {channel.name for channel in TABLE} < sent.keys()
    got = {
        ENV_SERVER: ("action",),
        AGENT: ("step",),
        LEARNER: ("log",),
        RECORDER: ("log", "window", "stats"),
    }
    for process, channels in got.items():
        for channel in channels:
            assert attacked.rejected(process, channel) == refused[channel] > sent[channel] / 2
        asked = f"control/{process}"
        assert attacked.rejected(process, "control") == refused[asked] > sent[asked] / 2
    asked_all = [name for name in sent if name.startswith("control/")]
    assert attacked.told["answered"] == sum(sent[name] - refused[name] for name in asked_all) > 0
    # The recorder's queue of policies holds 64, and what it loses counts as refused.
    recorder = attacked.final[RECORDER]
    assert 0 <= attacked.rejected(RECORDER, "policy") - refused["policy"] <= recorder["dropped"]
    # The agent looks at declarations when it needs one; the others also keep the newest, and judge that.
    assert sent["spec"] - DECLARED <= attacked.rejected(AGENT, "spec") <= sent["spec"] + 1
    for process in (LEARNER, RECORDER):
        assert refused["spec"] <= attacked.rejected(process, "spec") <= 2 * refused["spec"]


def test_what_was_said_before_is_told_apart_and_counted(attacked: Attacked) -> None:
    again = {name: n - attacked.told["refused"][name] for name, n in attacked.told["sent"].items()}
    assert min(again[channel.name] for channel in TABLE) > 10
    agent, env, learner = (attacked.final[name] for name in (AGENT, ENV_SERVER, LEARNER))
    judged = agent["policies.received"] + agent["policies.repeated"]
    assert judged + attacked.rejected(AGENT, "policy") >= attacked.told["sent"]["policy"]
    # A rehearsal is answered as often as it is heard, unless a later step was.
    assert 0 < agent["observations.repeated"] <= again["step"]
    assert agent["policies.past"] > 0
    assert 0 < env["action.stale"] <= again["action"] + env["missed"]
    assert learner["duplicate"] >= again["log"]  # each has a step at least
