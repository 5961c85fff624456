from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness import (
    ACTING,
    ROOT,
    BenchmarkError,
    child_result,
    policy,
    run_system,
    unprivileged,
    world,
    write_result,
)
from benchmarks.publish_adopt import Arguments, configure, policy_bytes
from rtcore.realtime import Privileges, privileges
from rtcore.spaces import Spaces
from rtcore.weights import verify


def test_a_random_policy_is_one_that_an_agent_takes() -> None:
    made = policy(17, 6, (32, 32))
    arrays = verify(made, Spaces(17, 6))
    assert sum(array.nbytes for array in arrays.values()) == policy_bytes(17, 6, (32, 32))


def test_policy_bytes_by_hand() -> None:
    # 2 -> 3 -> 2 heads of 1: (2 + 1) * 3 + (3 + 1) * 2 numbers
    assert policy_bytes(2, 1, (3,)) == 4 * 17


def test_the_arm_without_policies_differs_in_their_publication_alone() -> None:
    arguments = Arguments(seconds=20.0)
    with_, without = (configure(arguments, 256, publishes=publishes) for publishes in (True, False))
    assert with_.learner == without.learner
    assert (with_.env.unit_s, without.env.unit_s) == (1.0, 1e4)


def test_root_gives_up_what_an_ordinary_user_may_not_ask_for() -> None:
    command = [
        *unprivileged(),
        sys.executable,
        "-c",
        "from rtcore.realtime import privileges as p; print(p())",
    ]
    told = subprocess.check_output(command, cwd=ROOT, text=True).strip()
    ordinary = Privileges(max_priority=0, lock_memory=False)
    assert told == str(ordinary if os.geteuid() == 0 else privileges())


def test_the_acting_processes_run_and_are_told_as_one_outcome() -> None:
    config = world("pointmass", hz=100.0, seconds=0.5, rt="off")
    config = replace(config, env=replace(config.env, start_wait_s=3.0))
    found = run_system(config, ACTING, hidden=(16, 16))
    assert found.ticks + found.more["skipped"] == 50
    assert found.missed == sum(found.more["missed_by_cause"].values()) + found.more["skipped"]
    assert found.loop_us["p50"] is not None
    assert found.more["policies"]["adopted"] == 1
    assert set(found.more["placement"]) == set(ACTING)
    assert all(": SCHED_OTHER" in text for text in found.more["placement"].values())


def test_a_child_that_fails_says_why() -> None:
    with pytest.raises(BenchmarkError, match="No module named"):
        child_result("benchmarks.nothing", [], seconds=1.0)


def test_a_result_is_named_by_its_date(tmp_path: Path) -> None:
    arguments = Arguments(out=tmp_path / "results", seconds=3.0)
    path = write_result("x", arguments, ["numpy"], {"a": 1})
    found = json.loads(path.read_text())
    assert path.name == f"{found['date'][:10]}-x.json"
    assert (found["benchmark"], found["a"], found["arguments"]["seconds"]) == ("x", 1, 3.0)
    assert found["machine"]["versions"] == {"numpy": np.__version__}
    assert found["machine"]["cores"] == os.cpu_count()
