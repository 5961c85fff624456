"""`tenuto plan`: its constants, its panels, what it takes from a run, and the real command."""

from __future__ import annotations

import io
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from launcher import presets
from launcher.plan.command import plan
from launcher.plan.constants import LONGEST, read_constants, settle
from launcher.plan.envelope import fit
from launcher.plan.estimate import local_changes
from launcher.plan.panels import (
    DOMINANCE,
    DOMINANCES,
    RATE,
    RATES,
    SHORT,
    dominance,
    example,
    panels,
    short_window_holds,
)
from launcher.plan.picture import _panel, draw_plan
from launcher.plan.results import CAVEAT, as_json, calculus, render
from learner.theory.optimum import HoldProblem, best_split, environment_regret
from rtcore.config import ConfigError, DriftConfig
from tests.launcher.commands import tenuto, tree

# The first two rows of the table by hand: R^pi(0) = R^pi(1) = 10 (1 - .9^20) = 8.7842,
# R^env(0) = 6.164 (1.01^20 - 1) / .01 = 135.73
FLAGS = ("--window", "20", "--c-45", "6.164", "--eta", "1", "--tau", "0.1", "--alpha-1", "1.01")
GIVEN = {"window": 20, "c_45": 6.164, "eta": 1.0, "tau": 0.1, "alpha_1": 1.01}


def test_minima_of_the_four_panels() -> None:
    found = {panel.name: [curve.best.hold for curve in panel.curves] for panel in panels()}
    assert found == {
        "growth": [19, 22, 25, 27, 29],
        "scale": [22, 23, 25, 26, 28],
        "dominance": [0, 7, 8, 9],
        "rate": [13, 17, 25, 25, 25],
    }
    for panel in panels():
        for curve in panel.curves:
            assert curve.values[curve.best.hold] == min(curve.values)
            assert len(curve.values) == curve.problem.window + 1


def test_the_dominances_are_those_of_the_paper() -> None:
    for label, c_45 in DOMINANCES.items():
        assert dominance(replace(DOMINANCE, c_45=c_45)) == pytest.approx(label, abs=2e-5)


def test_a_higher_rate_does_not_lengthen_the_hold_in_general() -> None:
    assert short_window_holds() == (7, 5, 8, 10, 10)
    # With R^pi as the theorem's proof has it, without its 1 / x, the hold never shortens.
    assert [_least_without_division(replace(SHORT, eta=rate, tau=1.0)) for rate in RATES] == [0, 1, 8, 10, 10]
    # Nor does the long window's panel rise between its own rates, or below them.
    between = [best_split(replace(RATE, eta=rate, tau=1.0)).hold for rate in (1e-4, 0.01, 0.03, 0.1)]
    assert between == [25, 13, 11, 17]


def _least_without_division(problem: HoldProblem) -> int:
    def value(hold: int) -> float:
        left = (1 - problem.rate) ** (problem.window - hold)
        return problem.c_1 * (1 - left + hold * left) + environment_regret(problem, hold)

    return min(range(problem.window + 1), key=value)


def test_the_example_of_a_budget() -> None:
    # b = (0, 1/2, 0, 1/2, 0, .): Bbar(0, G) = sum_k (G - 1 - k) b_k. Bbar(0, 6) = 4/2 + 2/2 = 3;
    # Bbar(0, 4) = 2/2 = 1 and Bbar(4, 6) = 0; Bbar(0, 2) = 0 and Bbar(2, 6) = 2/2 = 1
    assert example() == pytest.approx([3, 3, 1, 1.5, 1, 2, 3])


def test_diamonds_stand_at_the_minima() -> None:
    for panel in panels():
        axes = Figure().subplots()
        _panel(axes, panel)
        diamonds = [line for line in axes.lines if line.get_marker() == "D"]
        curves = [line for line in axes.lines if line.get_marker() != "D"]
        for curve, diamond, drawn in zip(panel.curves, diamonds, curves, strict=True):
            (hold,), (height,) = np.asarray(diamond.get_xdata()), np.asarray(diamond.get_ydata())
            assert hold == curve.best.hold
            assert height == np.asarray(drawn.get_ydata()).min()


def test_what_is_left_out_is_neutral_and_said() -> None:
    planned = settle(GIVEN)
    assert planned.problem == HoldProblem(
        window=20, c_1=1.0, c_45=6.164, eta=1.0, tau=0.1, alpha_1=1.01, alpha_2=1.01, b_1=1.0, b_2=1.0
    )
    assert planned.origins["c_1"] == "default"
    assert planned.origins["alpha_2"] == "as alpha_1"
    assert planned.origins["eta"] == "flag"
    assert settle({"b_1": 3.0}, GIVEN).problem.b_2 == 3.0
    assert settle({"alpha_1": 1.5}, GIVEN).problem.alpha_1 == 1.5
    assert settle({"alpha_1": 1.5}, GIVEN).origins["c_45"] == "file"


def test_table_and_json_of_a_plan() -> None:
    planned = settle(GIVEN)
    told = as_json(planned)
    assert told["best"]["N"] == 8 and told["best"]["G"] == 12 and told["best"]["gamma_f"] == 0.6
    assert told["policy_term_alone"]["as_good"] == [0, 1]
    assert told["environment_term_alone"]["N"] == 10
    assert told["terms"][0]["policy"] == pytest.approx(8.7842, abs=1e-4)
    assert told["terms"][0]["environment"] == pytest.approx(135.73, abs=5e-3)
    assert told["calculus"] == {
        "environment_hold": pytest.approx(10.0),
        "environment_hold_printed": None,
        "hold": 8,
        "hold_printed": 7,
    }
    text = io.StringIO()
    Console(file=text, width=200).print(render(planned))
    shown = text.getvalue()
    for words in ("N* = 8, G* = 12, gamma_f* = 0.6", "--learner.schedule.l-f 20", CAVEAT, "as printed 7"):
        assert words in shown
    rows = [line.split() for line in shown.splitlines()]
    assert ["8", "12", "9.4351", "129.25", "138.68", "0.00", "%"] in rows


def test_a_long_window_is_listed_in_part_but_with_its_best() -> None:
    planned = settle(GIVEN | {"window": 1000, "alpha_1": 1.001})
    best = best_split(planned.problem).hold
    text = io.StringIO()
    Console(file=text, width=200).print(render(planned))
    listed = [line.split()[0] for line in text.getvalue().splitlines() if line.endswith("%  ")]
    assert {"0", str(best), "1000"} <= set(listed)
    assert len(listed) < 40
    assert len(as_json(planned)["terms"]) == 1001


def test_calculus_where_it_does_not_apply() -> None:
    assert calculus(settle(GIVEN | {"alpha_1": 1.0}).problem) is None
    assert calculus(settle(GIVEN | {"b_2": 0.0}).problem) is None


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


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["window = None", "must be given"]),
        (["--window", "0", *FLAGS[2:]], ["window = 0", "1..100000"]),
        (["--window", str(LONGEST + 1), *FLAGS[2:]], ["window = 100001"]),
        ([*FLAGS, "--alpha-1", "0"], ["alpha_1 = 0.0", "above 0"]),
        ([*FLAGS, "--alpha-2", "-2"], ["alpha_2 = -2.0", "above 0"]),
        ([*FLAGS, "--eta", "10"], ["eta = 10.0", "eta tau must be below 1"]),
        ([*FLAGS, "--b-1", "nan"], ["b_1 = nan", "at least 0"]),
        ([*FLAGS, "--out", "taken"], ["out = 'taken'", "must not exist yet"]),
        (["--figures", "--c-1", "2"], ["c_1 = '2.0'", "--figures"]),
        (["taken"], ["run = 'taken'", "summary.json"]),
        (["--config", "none.toml"], ["config = 'none.toml'", "readable"]),
        (["--config", "bad.toml"], ["config = 'bad.toml'", "TOML"]),
        (["--config", "key.toml"], ["gamma = 0.9", "unknown key", "alpha_1"]),
        (["--config", "text.toml"], ["alpha_1 = 'big'", "must be a number"]),
        (["--config", "half.toml"], ["window = 2.5", "an integer"]),
    ],
)
def test_wrong_input_is_one_line(
    arguments: list[str], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken").mkdir()
    Path("bad.toml").write_text("window = = 3\n")
    Path("key.toml").write_text("gamma = 0.9\n")
    Path("text.toml").write_text('alpha_1 = "big"\n')
    Path("half.toml").write_text("window = 2.5\n")
    before = tree(tmp_path)
    with pytest.raises(ConfigError) as caught:
        plan(arguments)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert tree(tmp_path) == before


def test_a_file_of_constants(tmp_path: Path) -> None:
    file = tmp_path / "constants.toml"
    file.write_text("window = 20\nc_45 = 6.164\neta = 1\ntau = 0.1\nalpha_1 = 1.01\n")
    assert read_constants(file) == GIVEN
    assert settle({}, read_constants(file)).problem == settle(GIVEN).problem


def test_the_figures_as_people_make_them(tmp_path: Path) -> None:
    done = tenuto("plan", "--figures", "--out", "figures", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "figures/plan.png").read_bytes().startswith(b"\x89PNG")
    told = json.loads((tmp_path / "figures/plan.json").read_text())
    assert [curve["N"] for curve in told["panels"]["growth"]] == [19, 22, 25, 27, 29]
    assert told["remarks"] == [CAVEAT]
    assert "0.98 at 19" in done.stdout
    wrong = tenuto("plan", *FLAGS, "--tau", "1", cwd=tmp_path)
    assert wrong.returncode == 2
    assert wrong.stderr == "tenuto: eta = 1.0: eta tau must be below 1, and tau is 1\n"


def test_planning_needs_neither_torch_nor_the_viewer(tmp_path: Path) -> None:
    script = (
        "import sys; from launcher.plan.command import plan;"
        f"plan({[*FLAGS, '--out', str(tmp_path / 'out')]!r});"
        "assert not {'torch', 'rerun'} & set(sys.modules), 'loaded'"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"plan.json", "plan.png"}


def test_a_plan_from_a_run(tmp_path: Path) -> None:
    """The chain's s rises by 1/40 a unit, and with it both ends' rewards by 1/80: B(t, t + j) = j / 80."""
    lived = tenuto(
        "sim", "chain", "--duration-s", "5", "--run-dir", "lived", "--env.drift.kind", "ramp",
        "--env.drift.span", "40", "--learner.schedule.l-f", "8", "--learner.schedule.gamma-f", "0.5",
        cwd=tmp_path,
    )  # fmt: skip
    assert lived.returncode == 0, lived.stderr
    done = tenuto("plan", "lived", "--c-1", "0.5", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
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
    (tmp_path / "lived/recording.rrd").unlink()
    without = tenuto("plan", "lived", cwd=tmp_path)
    assert without.returncode == 2 and "needs a recording.rrd" in without.stderr


def test_the_picture_of_a_run_has_its_envelopes(tmp_path: Path) -> None:
    envelopes = fit(np.ones(20), [0], 8), fit(np.ones(20), [4], 8)
    draw_plan(replace(settle(GIVEN), envelopes=envelopes), tmp_path / "both.png")
    draw_plan(settle(GIVEN), tmp_path / "one.png")
    sizes = [(tmp_path / name).stat().st_size for name in ("both.png", "one.png")]
    assert sizes[0] > sizes[1] > 10_000
