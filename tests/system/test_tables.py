"""Finite worlds over the same processes, messages and recordings as the others."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest

from launcher.cli import run_command
from launcher.summary import discrepancies
from recorder.reading import columns, document, spans
from tests.launcher.commands import command_line

pytestmark = pytest.mark.timeout(120)
UNIT_NS = 250_000_000
HOLDS = ("--learner.schedule.l-f", "4", "--learner.schedule.gamma-f", "0.5")  # 2 units, and 2


def summary_of(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "summary.json").read_text())
    return found


def sim(run: Path, preset: str, *arguments: str, duration_s: float) -> dict[str, Any]:
    """The summary of a run in virtual time, without what may differ between two."""
    options = ("--duration-s", str(duration_s), "--run-dir", str(run), "--no-record")
    assert run_command(["sim", preset, *options, *arguments]) == 0
    summary = summary_of(run)
    return {name: value for name, value in summary.items() if name not in ("run", "wall_s")}


def play(home: Path) -> Path:
    """Eight seconds of cliffworld with all four processes: 8 windows of 1 s, half of each a hold."""
    run = home / "run"
    done = subprocess.run(
        command_line(
            "run", "cliffworld", "--learner.algo", "fq", "--env.unit-s", "0.25", *HOLDS,
            "--duration-s", "8", "--run-dir", str(run), "--record",
        ),
        capture_output=True, text=True, timeout=55, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return run


@pytest.fixture(scope="module")
def real(played: Callable[[str], Any]) -> Path:
    found: Path = played("test_tables")
    return found


def test_a_real_run_reconciles(real: Path) -> None:
    summary = summary_of(real)
    assert discrepancies(summary) == []
    assert (summary["env"], summary["algo"], summary["ended"]) == ("cliffworld", "fq", "duration")
    assert summary["ticks"] + summary["deadlines"]["skipped"] == 8 * summary["tick_hz"]
    assert summary["transitions"]["lost"] == 0
    assert summary["learner"]["gradient_steps"] == summary["transitions"]["learned"]
    assert summary["policies"]["published"] >= 4
    assert summary["policies"]["adopted"] >= 4
    assert summary["policies"]["published_in_hold"] == summary["policies"]["rejected"] == 0
    assert summary["messages"]["rejected"] == summary["recorder"]["dropped"] == 0
    assert summary["windows"] == [{"m": m, "t_m": 4 * m, "G": 2, "N": 2} for m in range(8)]


def test_its_regret_is_of_every_tick(real: Path) -> None:
    """Two units of 50 ticks in each phase of each window; what nobody answered in time is left out."""
    summary = summary_of(real)
    regret = summary["regret"]
    assert summary["regret_missing"] is None
    assert (regret["units"], regret["update_units"], regret["hold_units"]) == (32, 16, 16)
    assert regret["ticks"] + regret["left_out_ticks"] == summary["transitions"]["produced"]
    assert regret["left_out_ticks"] == summary["deadlines"]["missed"]
    assert regret["per_unit"] > 0
    assert regret["total"] == pytest.approx(regret["update"] + regret["hold"])
    assert regret["worst_state"]["total"] > regret["total"]
    assert regret["bounds"] is None and "npg" in regret["bounds_missing"]


def test_its_recording_shows_phases_policies_and_every_tick(real: Path) -> None:
    recording, summary = real / "recording.rrd", summary_of(real)
    phases = spans(recording)
    assert [phase.state for phase in phases] == ["update", "hold"] * 8
    assert [phase.start_ns for phase in phases[1:]] == [2 * UNIT_NS * i for i in range(1, 16)]
    published, versions = columns(recording, "/learner/published_version", timeline="run_time")
    assert versions.ravel().tolist() == list(range(1, summary["policies"]["published"] + 1))
    holds = [(phase.start_ns, phase.end_ns) for phase in phases if phase.state == "hold"]
    for instant in published:
        assert not any(start < instant < (end or 2**62) for start, end in holds)
    ticks, reward = columns(recording, "/env/reward")
    assert len(ticks) == summary["ticks"]
    assert set(np.unique(reward)) <= {0.0, -1.0, 100.0, -100.0}  # 0 at a reset
    _, episode_returns = columns(recording, "/env/return")
    np.testing.assert_allclose(episode_returns.ravel(), summary["returns"], rtol=1e-5)


def test_its_run_card_speaks_of_tables(real: Path) -> None:
    card = document(real / "recording.rrd")
    for words in ("36 states", "4 actions", "`fq`, in a table", "random actions | 5 %", "past tables"):
        assert words in card
    for words in ("hidden", "critic", "batch"):
        assert words not in card


@pytest.mark.parametrize(
    ("preset", "algo"),
    [
        ("bandit", "q"), ("cliffworld", "fq"), ("random_mdp", "npg"), ("chain", "npg"),
        ("bandit_conservative", "tempo"),
    ],
)  # fmt: skip
def test_the_same_seed_gives_the_same_summary(preset: str, algo: str, tmp_path: Path) -> None:
    """500 ticks: 5 windows of 2 updates and 2 holds."""
    pace = ("--env.hz", "50", "--env.unit-s", "0.5")
    once, again = (
        sim(tmp_path / name, preset, "--learner.algo", algo, *pace, *HOLDS, duration_s=10)
        for name in ("once", "again")
    )
    assert once == again
    assert discrepancies(once) == []
    assert once["algo"] == algo
    assert once["deadlines"]["missed"] == once["policies"]["rejected"] == 0
    assert once["policies"]["adopted"] >= 5
    learned = 0 if algo == "tempo" else once["transitions"]["produced"]
    assert once["learner"]["gradient_steps"] == learned


def test_another_seed_gives_another_run(tmp_path: Path) -> None:
    runs = [sim(tmp_path / seed, "bandit", "--seed", seed, duration_s=5)["returns"] for seed in "12"]
    assert runs[0] != runs[1]


@pytest.mark.parametrize("algo", ["q", "fq", "npg"])
def test_a_bandit_that_stays_as_it_is_gets_learned(algo: str, tmp_path: Path) -> None:
    """Arm 1 pays always and arm 0 never: an episode of 49 earns 24.5 at first, and with a tenth of random
    actions 46.5 in the end."""
    still = ("--env.drift.kind", "constant", "--env.drift.offset", "0", "--learner.table.epsilon", "0.1")
    returns = sim(tmp_path / "run", "bandit", "--learner.algo", algo, *still, duration_s=20)["returns"]
    assert returns[0] < 35  # five standard deviations of 49 coins are 17.5
    assert fmean(returns[-5:]) > 43


def test_a_tempo_moves_the_choice_from_one_arm_to_the_other(tmp_path: Path) -> None:
    """Arm 1 pays: all is earned before beta rises in unit 5, and nothing after unit 15, when it is 1."""
    still = ("--env.drift.kind", "constant", "--env.drift.offset", "0")
    tempo = ("--learner.table.tempo-begin", "5", "--learner.table.tempo-span", "10")
    returns = sim(tmp_path / "run", "bandit_conservative", *still, *tempo, duration_s=20)["returns"]
    assert returns[1:5] == [49.0] * 4  # pi_0 acts in unit 0
    assert returns[16:] == [0.0] * 4
    assert 10 < returns[10] < 40


def test_the_goal_of_the_cliffworld_is_found(tmp_path: Path) -> None:
    """13 steps of -1 and a goal of 100, so 87; pi_0 falls ten times and more in an episode."""
    world = ("--env.unit-s", "0.05", "--env.cliff.inactive-goal", "ordinary", "--env.drift.kind", "none")
    learner = ("--learner.algo", "q", "--learner.gamma", "0.9", "--learner.schedule.l-f", "20")
    table = ("--learner.table.step-size", "0.2", "--learner.table.epsilon", "0.05")
    returns = sim(tmp_path / "run", "cliffworld", *world, *learner, *table, duration_s=20)["returns"]
    assert fmean(returns[:5]) < -500
    assert max(returns) == 87
    assert fmean(returns[-20:]) > 0
