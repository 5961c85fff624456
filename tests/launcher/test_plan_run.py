"""`tenuto plan RUN`: the constants that a run gives."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from launcher import presets
from launcher.cli import run_command
from launcher.plan.constants import settle
from launcher.plan.envelope import fit
from launcher.plan.estimate import _scales, local_changes
from launcher.plan.picture import draw_plan
from rtcore.config import DriftConfig

PLAN = settle({"window": 20, "c_45": 6.164, "eta": 1.0, "tau": 0.1, "alpha_1": 1.01})


def test_the_closest_envelope_of_a_budget_by_hand() -> None:
    # W = 3 and a change of 1 a unit: B k >= 1, B k^2 >= 2. Up to k = 2, B = 2 / k^2 costs 2/k^2 + 2/k + 2;
    # from there B = 1 / k costs 1/k + 1 + k. So k = 2, B = 1/2.
    line = fit(np.ones(9), [0, 3], 3)
    assert line.budget.tolist() == [0.0, 1.0, 2.0]
    assert line.growth == pytest.approx(2.0, rel=0.01)
    assert line.scale == pytest.approx(0.5, rel=0.02)
    assert line.begins == 2
    # One jump after the begin: B k >= 1 costs 1/k + 1 + k + k^2 + ..., so k -> 1
    jump = fit(np.array([1.0, 0.0, 0.0, 0.0]), [0], 5)
    assert jump.growth == pytest.approx(math.exp(1e-3))
    assert jump.scale == pytest.approx(math.exp(-1e-3))
    still = fit(np.zeros(5), [0], 3)
    assert (still.scale, still.growth) == (0.0, 1.0)


def test_an_envelope_covers_every_begin() -> None:
    changes = np.random.default_rng(0).uniform(size=60)
    begins = [3, 17, 40, 58]
    found = fit(changes, begins, 12)
    for begin in begins:
        for ahead in range(min(12, len(changes) - begin + 1)):
            budget = changes[begin : begin + ahead].sum()
            assert budget <= found.scale * found.growth**ahead * (1 + 1e-12)
    assert found.budget[11] == pytest.approx(max(changes[b : b + 11].sum() for b in (3, 17, 40)))


def test_changes_of_the_reward_from_the_drift() -> None:
    drift = np.array([0.5, 1.25, 1.25, -1.0])
    point = presets.load("pointmass")
    assert local_changes(point, drift, 9.0)[0].tolist() == [0.75, 0.0, 2.25]
    still = replace(point, env=replace(point.env, drift=DriftConfig(kind="none")))
    assert local_changes(still, drift, 9.0)[0].tolist() == [0.0, 0.0, 0.0]
    assert local_changes(presets.load("bandit"), drift, 1.0)[0].tolist() == [0.5, 0.0, 1.0]  # within [0, 1]
    assert local_changes(presets.load("cliffworld"), drift, 110.0)[0].tolist() == [110.0, 0.0, 110.0]
    chain = presets.load("chain")  # leaving the first state pays (1 + s) / 2, s = sin(2 pi t / 160)
    changes, _, dynamics = local_changes(chain, drift, 1.0)
    expected = np.abs(np.diff(np.sin(2 * np.pi * np.arange(4) / 160))) / 2
    assert changes == pytest.approx(expected) and not dynamics


def test_the_scales_by_hand() -> None:
    # gamma = 1/2, episodes of 2 steps: h = 1.5, k = 0.5. Rewards from -1 to 3: C_1 = 2.5 * 1.5 * 4,
    # C_4 = 2 h, C_5 = (0.5 + 1.5 / 0.5) * 3
    chain = presets.load("chain")
    short = replace(chain, learner=replace(chain.learner, gamma=0.5), env=replace(chain.env, episode_steps=2))
    reward = np.array([-1.0, 0.0, 3.0])
    still, _ = _scales(short, reward, dynamics=False)
    assert (still["c_1"], still["c_45"]) == pytest.approx((15.0, 3.0))
    moving, _ = _scales(short, reward, dynamics=True)
    assert (moving["c_1"], moving["c_45"]) == pytest.approx((15.0, 13.5))


@pytest.mark.parametrize("count", [1, 2])
def test_a_plan_from_a_run(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The chain's s rises by 1/40 a unit, and with it both ends' rewards by 1/80: B(t, t + j) = j / 80."""
    monkeypatch.chdir(tmp_path)
    lived = [
        "sim", "chain", "--duration-s", "5", "--run-dir", "lived", "--env.drift.kind", "ramp",
        "--env.count", str(count),
        "--env.drift.span", "40", "--learner.schedule.l-f", "8", "--learner.schedule.gamma-f", "0.5",
    ]  # fmt: skip
    assert run_command(lived) == 0
    assert run_command(["plan", "lived", "--c-1", "0.5", "--out", "out"]) == 0
    assert capsys.readouterr().err == ""
    told = json.loads((tmp_path / "out/plan.json").read_text())
    value = {name: one["value"] for name, one in told["constants"].items()}
    origin = {name: one["from"] for name, one in told["constants"].items()}
    assert value["window"] == 8 and origin["window"].startswith("the run's ")
    assert (value["eta"], value["tau"], value["c_1"]) == (0.2, 0.1, 0.5)
    assert origin["eta"].startswith("configured") and origin["c_1"] == "flag"
    assert value["c_45"] == pytest.approx(2 * (1 - 0.9**39) / 0.1)
    assert value["alpha_1"] == value["alpha_2"] > 1
    assert value["b_1"] == pytest.approx(value["b_2"])
    slack = [value["b_1"] * value["alpha_1"] ** ahead - ahead / 80 for ahead in range(8)]
    assert min(slack) == pytest.approx(0.0, abs=1e-12)
    assert told["environment_term_alone"]["N"] == 4
    assert told["unit_s"] == 0.2
    assert any("exact" in remark for remark in told["remarks"])
    assert ("what is recorded is of env0, the first of 2" in told["remarks"]) == (count == 2)
    config = Path("lived/run.toml").read_text()
    for before, after in (("\ngamma = 0.9\n", "\ngamma = 1.0\n"), ('"npg"', '"q"')):  # q may, npg may not
        assert before in config
        config = config.replace(before, after)
    Path("lived/run.toml").write_text(config)
    assert run_command(["plan", "lived"]) == 2
    assert capsys.readouterr().err == "tenuto: gamma = 1.0: must be in [0, 1)\n"
    Path("lived/recording.rrd").unlink()
    assert run_command(["plan", "lived"]) == 2
    assert capsys.readouterr().err == "tenuto: run = 'lived': needs a recording.rrd in it\n"


def test_the_picture_of_a_run_has_its_envelopes(tmp_path: Path) -> None:
    envelopes = fit(np.ones(20), [0], 8), fit(np.ones(20), [4], 8)
    draw_plan(replace(PLAN, envelopes=envelopes), tmp_path / "both.png")
    draw_plan(PLAN, tmp_path / "one.png")
    sizes = [(tmp_path / name).stat().st_size for name in ("both.png", "one.png")]
    assert sizes[0] > sizes[1] > 10_000
