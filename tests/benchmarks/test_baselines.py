"""Which runs can be held against baselines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.baselines import compare
from rtcore.config import EnvConfig, RunConfig
from rtcore.run_dir import RunDir


def test_the_returns_of_a_fleet_are_no_course_of_time(tmp_path: Path) -> None:
    config = RunConfig(env=EnvConfig(id="pointmass", hz=100.0, episode_steps=10, count=2))
    summary = '{"ticks": 0, "deadlines": {"skipped": 0}, "returns": []}'
    for count, why in ((2, "2 environments; needs a run of one"), (1, "0 episodes; needs 10")):
        one = replace(config, env=replace(config.env, count=count))
        run = RunDir.create(tmp_path / f"r{count}", one)
        run.summary_path.write_text(summary)
        with pytest.raises(SystemExit, match=why):
            compare(run.path)
