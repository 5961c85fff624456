"""The learner as a process, over Zenoh."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from rtcore import channels
from rtcore.config import AgentConfig
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import open_bus
from tests.learner.tabular.test_table_service import CONFIG, SPEC


def test_a_replay_that_does_not_fit_ends_it_with_the_difference_and_exit_code_2(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path / "run", replace(CONFIG, agent=AgentConfig(rt="off")))
    (run.learner_dir / "replay").mkdir()
    (run.learner_dir / "replay" / "cursor.json").write_text("{}")
    arguments = [sys.executable, "-m", "learner", "--run", str(run.path)]
    try:
        with open_bus(channels.ENV_SERVER, run.run_name, run.socket_dir(), clock=MonotonicClock()) as bus:
            bus.publisher(channels.SPEC, "env0").put(SPEC)
            root = Path(__file__).parents[2]
            done = subprocess.run(
                arguments, cwd=root, check=False, timeout=30, capture_output=True, text=True
            )
    finally:
        run.remove_socket_dir()
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()[-1:]
    assert line.startswith(
        "learner: learner.on_mismatch = 'refuse': must be 'fresh' to set aside what does not fit"
    )
    assert line.endswith("schema 2 or older (wanted 4)")
    assert [path.name for path in (run.learner_dir / "replay").iterdir()] == ["cursor.json"]
