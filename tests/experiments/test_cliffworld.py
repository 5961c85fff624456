"""The cliffworld's experiment: its lanes are the services' world and learners; its numbers by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from env_server.worlds.cliffworld import START, Cliffworld, tables
from experiments.cliffworld import (
    ARMS,
    DEFAULT,
    LATE,
    PLAIN,
    SPANS,
    Arguments,
    curve,
    differences,
    main,
    over,
    picture,
    readings,
    spans,
    write,
)
from experiments.intervals import interval, student_quantile
from experiments.lanes import EPISODE_STEPS, PAIRS, Arm, Luck, Reading, _Past, play
from learner.replay import Replay
from learner.tabular.fq import Fq
from learner.tabular.q import QLearning
from rtcore.config import CliffConfig, ForecastConfig, LearnerConfig, TableConfig
from rtcore.spaces import Spaces
from rtcore.windows import Window

STEPS, SWITCH = 300, 150
LANE = 6 + 3  # seed 1, alpha 0.2, epsilon 0.1
ONE_EACH = [reading for reading in readings() if (reading.gamma, reading.cliff.step_reward) == (0.9, -1)]


@pytest.fixture(scope="module")
def luck() -> Luck:
    return Luck.draw((0, 1), STEPS)


def test_the_readings_are_all_of_them() -> None:
    every = list(readings())
    assert len(set(every)) == len(every) == 24
    assert DEFAULT in every and PLAIN in every
    assert str(DEFAULT) == "leave, terminal, 1, -1" and str(PLAIN) == "arrive, ordinary, 0.9, -1"


@pytest.mark.parametrize("reading", ONE_EACH, ids=str)
@pytest.mark.parametrize("first", [0, 1])
def test_a_lane_is_the_world(reading: Reading, first: int) -> None:
    """The goal switches in the very step that would have paid."""
    luck = Luck.draw((0, 1), 2500)
    still = enumerate(play(reading, ARMS["Q"], luck, switch=2500, first=first))
    paid = [step for step, moment in still if moment.reward[LANE] == 100]
    switch = paid[len(paid) // 2]
    world = Cliffworld(reading.cliff, lambda t: float((t >= switch) != (first == 1)), seed=0)
    state, ends = world.reset(0, 0), 0
    for step, moment in enumerate(play(reading, ARMS["Q"], luck, switch=switch, first=first)):
        assert moment.state[LANE] == state[0]
        outcome = world.step(moment.action[LANE : LANE + 1].astype(np.float32), step)
        assert outcome.reward == moment.reward[LANE]
        assert outcome.observation[0] == moment.next_state[LANE]
        assert outcome.terminated == moment.terminated[LANE]
        ends += moment.over[LANE]
        state = world.reset(None, step) if moment.over[LANE] else outcome.observation
    assert ends >= 15


def _learner(arm: Arm, reading: Reading, replay: Replay) -> QLearning:
    """The services' own, with an episode for a unit and for a window."""
    alpha, epsilon = PAIRS[LANE % 6]
    config = LearnerConfig(
        gamma=reading.gamma,
        table=TableConfig(step_size=arm.step_factor * alpha, epsilon=epsilon),
        forecast=ForecastConfig(l_p=arm.l_p, horizon=arm.l_f),
    )
    of = QLearning if arm.acts == "live" else Fq
    return of(config, Spaces(1, 1, states=36, actions=4), 0, replay)


@pytest.mark.parametrize("name", ["Q", "Q, 2 alpha", "frozen Q", "FQ"])
@pytest.mark.parametrize("reading", [DEFAULT, PLAIN], ids=str)
def test_a_lane_is_the_services_learner(name: str, reading: Reading) -> None:
    luck = Luck.draw((0, 1), 1200)
    replay = Replay(4000, 1, 1)
    learner, episode, greedy_actions = _learner(ARMS[name], reading, replay), 0, 0
    for step, moment in enumerate(play(reading, ARMS[name], luck, switch=600)):
        if not luck.explore[step, LANE] and (episode or ARMS[name].acts == "live"):
            # in the first episode there is no past table: the services' policy is live, a lane's is Q at 0
            policy = learner.policy_arrays()["probability"]
            assert moment.action[LANE] == policy[moment.state[LANE]].argmax()
            greedy_actions += 1
        state, action, following = (
            np.array([array[LANE]], np.float32) for array in (moment.state, moment.action, moment.next_state)
        )
        ended = bool(moment.terminated[LANE])
        replay.add(state, action, float(moment.reward[LANE]), following, ended, episode)
        learner.update(improve_policy=True)
        np.testing.assert_array_equal(learner._q, moment.q[LANE])
        if moment.over[LANE]:
            learner.end_unit(episode)
            episode += 1
            learner.begin_window(Window(episode, episode, 1, 0), episode)
    assert episode >= 8 and greedy_actions > 800


def test_with_one_past_table_it_is_frozen_q_exactly(luck: Luck) -> None:
    """Written out for one lane: act on a copy of Q from the episode's start, learn in Q."""
    alpha, _ = PAIRS[LANE % 6]
    worlds = [tables(DEFAULT.cliff, goal) for goal in (0, 1)]
    q = np.zeros((36, 4))
    frozen, state, age = q.copy(), START, 0
    for step, moment in enumerate(play(DEFAULT, ARMS["frozen Q"], luck, switch=SWITCH)):
        explore = luck.explore[step, LANE]
        action = int(luck.action[step, LANE]) if explore else int(frozen[state].argmax())
        world = worlds[step >= SWITCH]
        reward, following = world.reward[state, action], int(world.next_state[state, action])
        ended = bool(world.terminated[state, action])
        target = reward + (0.0 if ended else DEFAULT.gamma * q[following].max())
        q[state, action] += alpha * (target - q[state, action])
        assert (moment.state[LANE], moment.action[LANE], moment.reward[LANE]) == (state, action, reward)
        np.testing.assert_array_equal(moment.q[LANE], q)
        state, age = following, age + 1
        if ended or age == EPISODE_STEPS:
            frozen, state, age = q.copy(), START, 0


def test_the_forecast_by_hand() -> None:
    """Two lanes of one number each; a line through past tables, read one episode on.

    Lane 0 ends episodes with 1, 3, 4: forecasts 1; 3 + 2 = 5; the line through (-2, 1), (-1, 3), (0, 4) has
    slope 3/2 and mean 8/3 at -1, so 8/3 + 2 * 3/2 = 17/3 at 1. Lane 1 never ends one, and stays at 0.
    """
    q = np.zeros((2, 1, 1))
    past = _Past(Arm(acts="forecast", l_p=3), q)
    for value, expected in ((1.0, 1.0), (3.0, 5.0), (4.0, 17 / 3)):
        q[:] = value
        past.end_episode(np.array([0]))
        np.testing.assert_allclose(past.forecast[:, 0, 0], [expected, 0.0])
    q[:] = 9.0  # 3, 4, 9 are left: slope 3, mean 16/3, so 16/3 + 2 * 3 = 34/3
    past.end_episode(np.array([0]))
    assert past.forecast[0, 0, 0] == pytest.approx(34 / 3)


def test_write_back_by_hand() -> None:
    """Through two tables, three episodes on: Qtilde = Q + 3 (Q - Q'), and 0.3 of that step is 0.9 (Q - Q').

    1: nothing before it. Then 2 -> 2 + 0.9 (2 - 1) = 2.9, then 3.9 -> 3.9 + 0.9 (3.9 - 2.9) = 4.8.
    """
    q = np.zeros((1, 1, 1))
    past = _Past(ARMS["write-back"], q)
    for learned, expected in ((1.0, 1.0), (2.0, 2.9), (3.9, 4.8)):
        q[:] = learned
        past.end_episode(np.array([0]))
        assert q[0, 0, 0] == pytest.approx(expected)


@pytest.mark.parametrize("name", list(ARMS))
def test_a_short_run_is_deterministic_and_seeds_do_not_see_each_other(name: str) -> None:
    both = Luck.draw((0, 1), 1000)
    one = curve(DEFAULT, ARMS[name], both, switch=400)
    assert one.shape == (2, 2)
    np.testing.assert_array_equal(one, curve(DEFAULT, ARMS[name], Luck.draw((0, 1), 1000), switch=400))
    alone = curve(DEFAULT, ARMS[name], Luck.draw((1,), 1000), switch=400)
    np.testing.assert_array_equal(alone, one[1:])
    assert (one[0] != one[1]).any()


def test_exploration_is_epsilon() -> None:
    """Of 40 000 draws a share of epsilon = 0.05 has a standard error of 0.0011, 0.1 one of 0.0015."""
    luck = Luck.draw((0, 1), 20_000)
    share = luck.explore.reshape(-1, 2, 6).mean((0, 1))
    np.testing.assert_allclose(share, [0.05, 0.1, 0.05, 0.1, 0.05, 0.1], atol=0.006)
    np.testing.assert_allclose(np.bincount(luck.action.ravel()) / luck.action.size, 0.25, atol=0.005)


def test_student_by_the_tables() -> None:
    known = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 9: 2.262, 19: 2.093, 30: 2.042, 100: 1.984}
    for freedom, quantile in known.items():
        assert student_quantile(freedom) == pytest.approx(quantile, abs=5e-4)


def test_interval_by_hand() -> None:
    """1, 2, 3: mean 2, standard deviation 1, so 4.3027 / sqrt(3) = 2.4841."""
    found = interval([1.0, 2.0, 3.0])
    assert [found.mean, found.half] == pytest.approx([2.0, 2.4841], abs=1e-4)
    assert not found.apart and interval([3.0, 3.1, 3.2]).apart
    assert str(found) == "2.00 ± 2.48" and str(interval([-0.001, -0.001])) == "0.00 ± 0.00"


def _made_up() -> dict[str, np.ndarray]:
    """[3 seeds, 40 bins]: the bin's number, plus the seed's, plus 10 per arm."""
    bins = np.arange(40.0) + np.arange(3.0)[:, None]
    return {name: bins + 10.0 * n for n, name in enumerate(ARMS)}


def test_spans_are_bins() -> None:
    """Steps 9000 to 10000 are bins 18 and 19, 15500 to 16500 are 31 and 32; arms differ by 10, paired."""
    curves = _made_up()
    np.testing.assert_allclose(over(curves["Q"], SPANS[0]), [18.5, 19.5, 20.5])
    np.testing.assert_allclose(over(curves["Q"], SPANS[2]), [31.5, 32.5, 33.5])
    assert spans(curves)["FQ"][0].mean == pytest.approx(29.5)
    found = differences(curves)
    assert [found["FQ - Q"][1].mean, found["FQ - Q"][1].half] == pytest.approx([10.0, 0.0])
    assert found["FQ - frozen Q"][3].mean == pytest.approx(-10.0)


def test_what_is_written(tmp_path: Path) -> None:
    found = dict.fromkeys((DEFAULT, PLAIN), _made_up())
    path = write(Arguments(seeds=3, out=tmp_path / "out"), found, {LATE: _made_up()})

    def refuse(name: str) -> float:
        raise AssertionError(f"{name} is not JSON")

    results = json.loads(path.read_text(), parse_constant=refuse)
    assert results["seeds"] == [0, 1, 2]
    assert results["readings"][0]["reading"]["cliff"]["pays"] == "leave"
    assert results["readings"][1]["reward"]["FQ"][0][0] == 29.5
    assert len(results["default_reading"][LATE]["curve"]["Q"]["mean"]) == 40
    picture(found, _made_up(), tmp_path / "docs" / "cliffworld.png")
    assert (tmp_path / "docs" / "cliffworld.png").read_bytes().startswith(b"\x89PNG")


def test_one_seed_is_refused() -> None:
    with pytest.raises(SystemExit, match="seeds = 1: must be 2 or more"):
        main(Arguments(seeds=1))


def test_the_reading_reaches_the_lanes() -> None:
    """Leaving pays a step later than arriving."""
    luck = Luck.draw((0,), 50)
    arrive, leave = (
        [moment.reward[0] for moment in play(reading, Arm(), luck, switch=50)]
        for reading in (PLAIN, Reading(CliffConfig(inactive_goal="ordinary"), 0.9))
    )
    assert arrive != leave
