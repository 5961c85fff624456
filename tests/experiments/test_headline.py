"""Algorithm 1 in the two-goal chain: each arm does what its name says, and regret is exact."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments import headline
from experiments.headline import (
    ARMS,
    DRIFTING,
    NO_HOLD,
    RANDOM,
    STATIONARY,
    Arguments,
    Found,
    of_best_fixed,
)
from experiments.headline_arms import (
    MOST,
    WINDOW,
    Arm,
    Learner,
    forecast,
    live,
    matched_rate,
)
from experiments.headline_worlds import GAMMA, Floats, Luck, Setting, make_worlds
from learner.schedule.bound import bound_choice
from learner.tabular.table import npg_step
from learner.theory.mdp import TimeElapsingMdp
from learner.theory.regret import per_unit

SHAPE = (1, 2, 2)  # one lane, two states, two actions


def _changes(arm: Arm, units: int = 2 * WINDOW) -> list[int]:
    """The units after which the policy changed, while one action's value rises."""
    learner = Learner(arm, 0.2, np.zeros((3 * WINDOW, *SHAPE)))
    tables = np.zeros((units, *SHAPE))
    tables[..., 0] = 0.05 * np.arange(units)[:, None, None] + 1
    changed = []
    for t in range(units):
        before = learner.log_policy.copy()
        learner.end_unit(t, tables[max(0, t - 19) : t + 1])
        if (learner.log_policy != before).any():
            changed.append(t)
    return changed


def test_when_the_policy_is_improved() -> None:
    window = np.arange(WINDOW)
    assert _changes(Arm(update=5)) == [*window[:5], *window[:5] + WINDOW]
    assert _changes(Arm(update=5, first="hold")) == [*window[-5:], *window[-5:] + WINDOW]
    assert _changes(Arm(update=5, matched=True)) == list(range(2 * WINDOW))


def test_the_matched_rate_moves_as_far() -> None:
    """beta = 0.8 at eta 0.2. Twenty steps at the lower rate are five at 0.2, towards the same Q."""
    assert matched_rate(0.2, WINDOW) == pytest.approx(0.2)
    q = np.array([[1.0, -0.5]])
    ends = []
    for eta, steps in ((0.2, 5), (matched_rate(0.2, 5), WINDOW)):
        log_policy = np.log([[0.3, 0.7]])
        for _ in range(steps):
            log_policy = npg_step(log_policy, q, eta=eta, entropy=0.1, gamma=GAMMA)
        ends.append(log_policy)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)


@pytest.mark.parametrize(
    ("arm", "at_t_m", "four_later"),
    [
        (Arm(), 4.0, 4.0),  # 20 units after t_m = 20, from what is known then: 2 + 0.1 x 20
        (Arm(ahead="next"), 2.1, 2.5),  # each unit's own: 21, 25
        (Arm(ahead="none"), 2.0, 2.0),
        (Arm(ahead="exact"), 3.0, 3.0),
        (Arm(refresh="unit", ahead="next"), 2.1, 2.0),  # at 24 all is as it was at 20, so the line is bent
        (Arm(refresh="unit", ahead="none"), 2.0, 2.0),
    ],
)
def test_what_the_policy_is_improved_towards(arm: Arm, at_t_m: float, four_later: float) -> None:
    """Q rises by 0.1 a unit until t_m = 20, and then stays. A step of 1 - beta = 0.2 from a uniform policy
    towards (Q, 0) makes log odds of 0.2 x Q / tau = 2 Q; the next one, 0.8 of these and 2 Q more."""
    rising = np.minimum(np.arange(2 * WINDOW), WINDOW) * 0.1
    tables = np.stack([rising, np.zeros(2 * WINDOW)], -1)[:, None, None].repeat(2, axis=2)
    truth = np.zeros((2 * WINDOW + 1, *SHAPE))
    truth[2 * WINDOW, ..., 0] = 3.0
    learner, seen = Learner(arm, 0.2, truth), 0.0
    for t in range(WINDOW + 5):
        before = np.diff(learner.log_policy)[0, 0, 0]
        learner.end_unit(t, tables[max(0, t - 19) : t + 1])
        seen = -(np.diff(learner.log_policy)[0, 0, 0] - 0.8 * before) / 2
        if t == WINDOW:
            assert seen == pytest.approx(at_t_m)
    if arm.refresh == "unit" and arm.ahead == "next":
        # fit by hand: np.polyfit over units 5 .. 24, read at 25
        four_later = float(np.polyval(np.polyfit(np.arange(5, 25), rising[5:25], 1), 25))
    assert seen == pytest.approx(four_later)


def test_shrinking_trusts_a_line_and_no_noise() -> None:
    """A line has no residuals, so rho = 1; the slope of noise is about its own error, so rho = 0."""
    line = 0.02 * np.arange(20.0)[:, None, None, None] * np.ones(SHAPE)
    assert forecast(line, 10, shrink=True) == pytest.approx(np.full(SHAPE, 0.02 * 29))
    noise = np.random.default_rng(0).normal(size=(20, *SHAPE))
    np.testing.assert_allclose(forecast(noise, 10, shrink=True), noise.mean(0))
    assert np.abs(forecast(noise, 10, shrink=False) - noise.mean(0)).max() > 0.1
    assert forecast(100 * line, 20, shrink=False).max() == MOST


def test_shrinking_by_hand() -> None:
    """x = -1.5 .. 1.5 with Sxx = 5; (1, -1, -1, 1) / 4 is orthogonal to 1 and x, and leaves RSS = 1 / 4.

    se^2 = 1/4 / (2 x 5) = 0.025 and rho = 1 - 10 x 0.025 = 0.75; one unit ahead is x = 2.5.
    """
    values = np.array([-1.5, -0.5, 0.5, 1.5]) + np.array([1, -1, -1, 1]) / 4 + 3
    past = np.multiply.outer(values, np.ones(SHAPE))
    np.testing.assert_allclose(forecast(past, 1, shrink=False), 5.5)
    np.testing.assert_allclose(forecast(past, 1, shrink=True), 3 + 0.75 * 2.5)


def _window_ahead(arm: Arm, past: Floats) -> int:
    """G at t_m = 20, given the tables of the units 1 .. 20, after a window in which nothing was known."""
    learner = Learner(arm, 0.2, np.zeros((3 * WINDOW, *SHAPE)))
    learner.end_unit(WINDOW, past)
    return int(learner.update[0])


def test_a_plan_holds_on_a_line_and_on_noise_only_if_trusted() -> None:
    """Actions change places late in the coming window, so it pays to do little before; with noise
    of the same size on the tables, a gate closes."""
    ahead = 0.1 * (np.arange(20.0) - 34)  # Q(., 0): -1.5 at t_m, 0 at t_m + 15, 0.5 at t_{m+1}
    line = np.stack([ahead, -ahead], -1)[:, None, None].repeat(2, axis=2)
    noisy = line + np.random.default_rng(3).normal(0, 2.0, line.shape)
    gated = Arm(update="plan", least_trust=0.5)
    assert _window_ahead(gated, line) == _window_ahead(Arm(update="plan"), line) < WINDOW
    assert _window_ahead(Arm(update="plan"), noisy) < _window_ahead(gated, noisy) == WINDOW
    assert _window_ahead(Arm(update="plan", least_gain=1.1), line) == WINDOW


def test_the_bound_s_choice_of_a_window() -> None:
    """From the tables' slope: 0 in tables that stay, and of a unit in a line."""
    line = 0.1 * np.arange(20.0)[:, None, None, None] * np.array([1.0, -1.0]) * np.ones(SHAPE)
    learner = Learner(Arm(update="bound"), 0.2, np.zeros((3 * WINDOW, *SHAPE)))
    before, slope = learner.log_policy.copy(), np.broadcast_to(np.array([0.1, -0.1]), SHAPE)
    learner.end_unit(WINDOW, line)
    target = line[-1] + WINDOW * slope
    expected = bound_choice(before, target, slope, window=WINDOW, eta=0.2, tau=0.1, gamma=GAMMA)
    assert learner.update.tolist() == expected.tolist() and 1 < expected[0] < WINDOW
    assert _window_ahead(Arm(update="bound"), np.ones((20, *SHAPE))) == WINDOW


@pytest.mark.parametrize("setting", [DRIFTING, RANDOM[0]])
def test_regret_is_that_of_the_library(setting: Setting) -> None:
    """Against the other way to it, world by world, for a policy that is not stationary."""
    worlds = make_worlds(setting, range(2), 30)
    states, actions = worlds.reward.shape[-2:]
    policy = np.random.default_rng(1).dirichlet(np.ones(actions), (30, 2, states))
    regret = worlds.optimal().v @ worlds.start - worlds.lived(policy)
    for lane in range(2):
        transition = np.broadcast_to(worlds.transition[lane], (30, *worlds.transition[lane].shape))
        world = TimeElapsingMdp(worlds.reward[:, lane], transition, GAMMA)
        np.testing.assert_allclose(regret[:, lane], per_unit(world, policy[:, lane], start=worlds.start))


def test_the_chain_by_hand() -> None:
    """Stationary: the first state pays (1 + 0.5) / 2, the last (1 - 0.5) / 2; from the middle, two steps of
    nothing and then 0.75 for ever: 0.81 x 7.5."""
    worlds = make_worlds(STATIONARY, range(2), 3)
    assert worlds.reward[0, 0, [0, -1], 0].tolist() == [0.75, 0.25]
    np.testing.assert_allclose(worlds.optimal().v @ worlds.start, 0.81 * 7.5)


def test_regret_begins_with_the_uniform_policy() -> None:
    """Which acts in unit 0, whatever the arm."""
    worlds, luck = make_worlds(DRIFTING, range(2), 30), Luck.draw(range(2), 2)
    uniform = np.full((2, 2, 5, 2), 0.5)
    expected = worlds.optimal().v[0] @ worlds.start - worlds.lived(uniform)[0]
    regret, _ = live(worlds, [ARMS["live"], ARMS["G=5"]], 0.2, luck)
    np.testing.assert_allclose(regret[:, 0], [expected, expected])


def test_lanes_and_arms_are_independent() -> None:
    """What a lane lives does not depend on the lanes and arms beside it, and arms share its chance."""

    def regret(names: list[str], seeds: range) -> Floats:
        worlds, luck = make_worlds(DRIFTING, seeds, 60), Luck.draw(seeds, 60)
        return live(worlds, [ARMS[name] for name in names], 0.2, luck)[0]

    both = regret(["G=5", "live", "plan"], range(3))
    np.testing.assert_allclose(both[1:2, :, 1:2], regret(["live"], range(1, 2)), rtol=1e-9)
    same = regret([NO_HOLD, NO_HOLD], range(2))
    np.testing.assert_array_equal(same[0], same[1])


def test_a_plan_of_all_updates_is_no_hold() -> None:
    worlds, luck = make_worlds(DRIFTING, range(2), 60), Luck.draw(range(2), 60)
    arms = [ARMS[NO_HOLD], Arm(update="plan", least_gain=1.1)]
    regret, update = live(worlds, arms, 0.2, luck)
    np.testing.assert_array_equal(regret[0], regret[1])
    np.testing.assert_allclose(update, WINDOW)


def test_shares_of_the_best_fixed_by_hand() -> None:
    """Two settings: 1 / 2 and 8 / 2 of the best fixed: the geometric mean is sqrt(0.5 x 4)."""
    fixed = {name: np.full(3, 2.0 + i) for i, name in enumerate(headline.FIXED)}
    results = {
        setting: Found({**fixed, "a": np.full(3, value)}, {}, {}, {}, {})
        for setting, value in ((DRIFTING, 1.0), (STATIONARY, 8.0))
    }
    assert of_best_fixed(results, "a") == pytest.approx((2**0.5,) * 3)


def test_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two settings with two lanes: the table, the file and the picture."""
    monkeypatch.setattr(headline, "FAMILY", (DRIFTING, STATIONARY))
    monkeypatch.setattr(headline, "RANDOM", (Setting(world="random"),))
    monkeypatch.setattr(headline, "SLOWER", DRIFTING)
    monkeypatch.setattr(headline, "run", _short)
    headline.main(Arguments(2, tmp_path, tmp_path / "p.png"))
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    [path] = tmp_path.glob("*-headline.json")
    content = json.loads(path.read_text())
    assert len(content["settings"]) == 3
    arms = content["settings"][0]["arms"]
    assert arms[NO_HOLD]["less_no_hold"] == [0.0, 0.0]
    lanes = np.subtract(arms["plan"]["by_lane"], arms["live"]["by_lane"])
    difference = content["settings"][0]["difference"]["plan - live"]
    assert len(lanes) == 2 and difference[0] == pytest.approx(lanes.mean(), abs=2e-5)


def _short(setting: Setting, seeds: range, arms: dict[str, Arm]) -> Found:
    worlds, luck = make_worlds(setting, seeds, 40 + WINDOW), Luck.draw(seeds, 40)
    regret, update = live(worlds, list(arms.values()), setting.eta, luck)
    window = {name: one[-WINDOW:] for name, one in zip(arms, regret, strict=True)}
    return Found(
        {name: one.mean(0) for name, one in window.items()},
        window,
        dict(zip(arms, update.mean((1, 2)).tolist(), strict=True)),
        {name: one[-1] for name, one in window.items()},
        dict(zip(arms, update[:, -1].mean(1).tolist(), strict=True)),
    )
