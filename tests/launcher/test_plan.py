"""`tenuto plan`: its constants, its panels, wrong input, and the real command."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from launcher.cli import run_command
from launcher.plan.constants import LONGEST, read_constants, settle
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
from launcher.plan.picture import _panel
from launcher.plan.results import CAVEAT, as_json, calculus, render
from learner.theory.optimum import HoldProblem, best_settled_split, best_split, environment_regret
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
            if panel.name in ("dominance", "rate"):  # the exponent G - 1 moves none of them
                assert best_settled_split(curve.problem).hold == curve.best.hold


def test_the_dominances_are_those_of_the_paper() -> None:
    for label, c_45 in DOMINANCES.items():
        assert dominance(replace(DOMINANCE, c_45=c_45)) == pytest.approx(label, abs=2e-5)


def test_the_dominance_by_hand() -> None:
    # W = 1, C_1 = 1, C_4 + C_5 = 3: at N = 0 R^env = 3 of 4, at N = 1 R^env = 3 / 3 of 2
    assert dominance(replace(DOMINANCE, window=1, c_45=3.0, b_2=1 / 3)) == pytest.approx((0.75 + 0.5) / 2)


def test_a_higher_rate_does_not_lengthen_the_hold_in_general() -> None:
    assert short_window_holds() == (7, 5, 8, 10, 10)
    # with (1 - x)^(G - 1) in R^pi two of them are a unit less
    settled = [best_settled_split(replace(SHORT, eta=rate, tau=1.0)).hold for rate in RATES]
    assert settled == [7, 4, 7, 10, 10]
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


def test_nothing_needs_to_grow_where_nothing_changes() -> None:
    still = settle(GIVEN | {"alpha_1": 1.0, "b_1": 0.0})
    assert as_json(still)["best"]["as_good"] == [0, 1]


def test_table_and_json_of_a_plan() -> None:
    planned = settle(GIVEN)
    told = as_json(planned)
    assert told["best"]["N"] == 8 and told["best"]["G"] == 12 and told["best"]["gamma_f"] == 0.6
    assert told["settled"]["N"] == 8 and told["policy_term_alone"]["as_good"] == [0, 1]
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
    assert calculus(replace(settle(GIVEN).problem, alpha_1=1.0)) is None
    assert calculus(settle(GIVEN | {"b_2": 0.0}).problem) is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["window = None", "must be given"]),
        (["--window", "0", *FLAGS[2:]], ["window = 0", "1..100000"]),
        (["--window", str(LONGEST + 1), *FLAGS[2:]], ["window = 100001"]),
        (["--window", "2.5", *FLAGS[2:]], ["window = '2.5'"]),
        ([*FLAGS, "--alpha-1", "0"], ["alpha_1 = 0.0", "above 0"]),
        ([*FLAGS, "--alpha-1", "1"], ["alpha_1 = 1.0", "above 1", "Assumption 1"]),
        ([*FLAGS, "--alpha-2", "0.9"], ["alpha_2 = 0.9", "above 1", "Assumption 1"]),
        (["--config", "flat.toml"], ["alpha_1 = 1", "above 1"]),
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
    arguments: list[str],
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken").mkdir()
    Path("bad.toml").write_text("window = = 3\n")
    Path("key.toml").write_text("gamma = 0.9\n")
    Path("text.toml").write_text('alpha_1 = "big"\n')
    Path("half.toml").write_text("window = 2.5\n")
    Path("flat.toml").write_text("window = 20\nc_45 = 1\neta = 1\ntau = 0.1\nalpha_1 = 1\n")
    before = tree(tmp_path)
    assert run_command(["plan", *arguments]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in words), said
    assert said.startswith("tenuto: ") and said.count("\n") == 1
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
