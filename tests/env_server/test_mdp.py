"""Finite MDPs between two ends: tables, budgets and samples."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from env_server.worlds.finite import Tables
from env_server.worlds.mdp import Chain, DriftingMdp, RandomMdp, chain_ends, random_ends
from rtcore.config import ConfigError, MdpConfig

BOTH = MdpConfig(states=4, actions=3, concentration=0.5, drifting="both")


def ramp(t: int) -> float:
    return t / 10


def test_the_line_between_two_ends_by_hand() -> None:
    """A quarter of the way: R = 0.75 * 1 + 0.25 * 0 = 0.75; P's first row 0.75 [1, 0] + 0.25 [0.2, 0.8]."""
    a = Tables(np.array([[1.0], [0.0]]), np.array([[[1.0, 0.0]], [[0.5, 0.5]]]))
    b = Tables(np.array([[0.0], [0.4]]), np.array([[[0.2, 0.8]], [[0.5, 0.5]]]))
    between = a.towards(b, 0.25)
    np.testing.assert_allclose(between.reward, [[0.75], [0.1]])
    np.testing.assert_allclose(between.transition, [[[0.8, 0.2]], [[0.5, 0.5]]])


def test_budgets_by_hand() -> None:
    """Same ends; w goes 0, 0, 0.5, 0.25, so |dw| = 0, 0.5, 0.25.

    From end to end R changes by |0 - 1| = 1 at most, P in L1 by |1 - 0.2| + |0 - 0.8| = 1.6.
    So b_r = 0, 0.5, 0.25 and b_p = 0, 0.8, 0.4.
    """
    a = Tables(np.array([[1.0], [0.0]]), np.array([[[1.0, 0.0]], [[0.5, 0.5]]]))
    b = Tables(np.array([[0.0], [0.4]]), np.array([[[0.2, 0.8]], [[0.5, 0.5]]]))
    weights = [0.0, 0.0, 0.5, 0.25]
    mdp = DriftingMdp((a, b), lambda value: value, lambda t: weights[t], seed=0)
    b_r, b_p = mdp.budgets(3)
    np.testing.assert_allclose(b_r, [0.0, 0.5, 0.25])
    np.testing.assert_allclose(b_p, [0.0, 0.8, 0.4])


@pytest.mark.parametrize("drifting", ["reward", "dynamics", "both"])
def test_budgets_by_brute_force(drifting: str) -> None:
    config = MdpConfig(states=3, actions=2, concentration=0.4, drifting=drifting)  # type: ignore[arg-type]
    mdp = RandomMdp(lambda t: 0.5 + 0.7 * np.sin(1.3 * t), config, seed=3)  # leaves [0, 1] on both sides
    b_r, b_p = mdp.budgets(12)
    for t in range(12):
        now, then = mdp.tables(t), mdp.tables(t + 1)
        most_r = most_p = 0.0
        for s, a in itertools.product(range(3), range(2)):
            most_r = max(most_r, abs(then.reward[s, a] - now.reward[s, a]))
            change = sum(abs(then.transition[s, a, n] - now.transition[s, a, n]) for n in range(3))
            most_p = max(most_p, change)
        assert (b_r[t], b_p[t]) == pytest.approx((most_r, most_p), abs=1e-12)
    assert (b_r.max() > 0) == (drifting != "dynamics")
    assert (b_p.max() > 0) == (drifting != "reward")


def test_the_weight_is_the_drift_kept_within_the_ends() -> None:
    a, b = random_ends(BOTH, 3)
    mdp = RandomMdp(lambda t: [-0.5, 0.0, 0.25, 1.0, 7.0][t], BOTH, seed=3)
    for t, weight in enumerate([0.0, 0.0, 0.25, 1.0, 1.0]):
        np.testing.assert_allclose(mdp.tables(t).reward, (1 - weight) * a.reward + weight * b.reward)
        expected = (1 - weight) * a.transition + weight * b.transition
        np.testing.assert_allclose(mdp.tables(t).transition, expected)


@pytest.mark.parametrize("concentration", [1e-6, 0.3, 100.0])
def test_rows_are_distributions_and_rewards_within_0_and_1(concentration: float) -> None:
    mdp = RandomMdp(ramp, MdpConfig(concentration=concentration, drifting="both"), seed=9)
    for t in range(12):
        tables = mdp.tables(t)
        assert tables.reward.shape == (6, 3) and tables.transition.shape == (6, 3, 6)
        assert (tables.transition >= 0).all()
        np.testing.assert_allclose(tables.transition.sum(axis=-1), 1.0, atol=1e-12)
        assert (tables.reward >= 0).all() and (tables.reward <= 1).all()


def test_the_mdp_is_the_seeds_own_and_episodes_do_not_change_it() -> None:
    mdp, twin, other = (RandomMdp(ramp, BOTH, seed=seed) for seed in (3, 3, 4))
    before = mdp.tables(5)
    mdp.reset(8, 0)
    for table in ("reward", "transition"):
        np.testing.assert_array_equal(getattr(mdp.tables(5), table), getattr(before, table))
        np.testing.assert_array_equal(getattr(twin.tables(5), table), getattr(before, table))
        assert not np.allclose(getattr(other.tables(5), table), getattr(before, table))


def test_what_drifts_does_not_change_where_it_begins() -> None:
    ends = [random_ends(MdpConfig(drifting=drifting), 3)[0] for drifting in ("reward", "dynamics", "both")]
    for end in ends[1:]:
        np.testing.assert_array_equal(end.reward, ends[0].reward)
        np.testing.assert_array_equal(end.transition, ends[0].transition)


def test_steps_follow_the_table_of_their_unit() -> None:
    """4000 steps from each (s, a): a frequency's sd is at most sqrt(0.25 / 4000) = 0.0079, the bound 4 sd.

    Unit 7 comes after unit 0, so a table kept from before would show.
    """
    mdp = RandomMdp(ramp, MdpConfig(states=3, actions=2, concentration=1.0, drifting="both"), seed=2)
    mdp.reset(2, 0)
    for t in (0, 7):
        tables = mdp.tables(t)
        for s, a in itertools.product(range(3), range(2)):
            counts = np.zeros(3)
            for _ in range(4000):
                mdp.state = s
                outcome = mdp.step(np.array([a], np.float32), t)
                counts[int(outcome.observation[0])] += 1
                assert outcome.reward == tables.reward[s, a]
            np.testing.assert_allclose(counts / 4000, tables.transition[s, a], atol=0.032)


class Edges:
    """Draws the ends of [0, 1), and 1/3 between them."""

    def __init__(self) -> None:
        self.draws = itertools.cycle([0.0, 1 / 3, np.nextafter(1.0, 0.0)])

    def random(self) -> float:
        return float(next(self.draws))


def test_a_state_without_probability_is_never_entered() -> None:
    """P = [0, 1/3, 0, 2/3, 0] in every row: the first, a middle and the last state are out of reach."""
    rows = np.broadcast_to(np.array([0.0, 1 / 3, 0.0, 2 / 3, 0.0]), (5, 1, 5))
    tables = Tables(np.zeros((5, 1)), rows)
    mdp = DriftingMdp((tables, tables), lambda _: 0.0, lambda _: 0.0, seed=0)
    mdp.reset(0, 0)

    mdp.random = Edges()  # type: ignore[assignment]
    seen = [int(mdp.step(np.zeros(1, np.float32), 0).observation[0]) for _ in range(3)]
    assert seen == [1, 3, 3]


def test_the_largest_draw_finds_a_state_though_the_row_sums_to_less_than_1() -> None:
    """Ten times 0.1 add up to 1 - 1.1e-16 in floats, which is also the largest number below 1."""
    rows = np.full((10, 1, 10), 0.1)
    assert rows.cumsum(axis=-1)[0, 0, -1] == np.nextafter(1.0, 0.0)
    tables = Tables(np.zeros((10, 1)), rows)
    mdp = DriftingMdp((tables, tables), lambda _: 0.0, lambda _: 0.0, seed=0)
    mdp.random = Edges()  # type: ignore[assignment]
    assert [int(mdp.step(np.zeros(1, np.float32), 0).observation[0]) for _ in range(3)] == [0, 3, 9]


def test_episodes_begin_anywhere() -> None:
    """600 starts over 3 states: sd of a share sqrt(2/9 / 600) = 0.019, the bound 4 of them."""
    mdp = RandomMdp(ramp, MdpConfig(states=3), seed=0)
    starts = [int(mdp.reset(None, 0)[0]) for _ in range(600)]
    np.testing.assert_allclose(np.bincount(starts, minlength=3) / 600, 1 / 3, atol=0.077)


def test_chain_by_hand() -> None:
    """s = 0.5: leaving the first state earns 0.75, the last 0.25; from s = -3, clipped to -1: 0 and 1."""
    chain = Chain(lambda t: [0.5, -3.0][t], MdpConfig(states=5, slip=0.0), seed=0)
    np.testing.assert_allclose(chain.tables(0).reward[:, 0], [0.75, 0, 0, 0, 0.25])
    np.testing.assert_allclose(chain.tables(0).reward[:, 1], [0.75, 0, 0, 0, 0.25])
    np.testing.assert_allclose(chain.tables(1).reward[:, 0], [0, 0, 0, 0, 1])
    assert (chain.states, chain.actions) == (5, 2)
    chain.reset(0, 0)
    walks = {0: [1, 0, 0], 1: [3, 4, 4]}  # left from state 2: 1, 0 and the wall; right: 3, 4 and the wall
    for action, expected in walks.items():
        chain.state = 2
        steps = [chain.step(np.array([action], np.float32), 0) for _ in range(3)]
        assert [int(step.observation[0]) for step in steps] == expected
        assert [step.reward for step in steps] == [0, 0, 0.75 if action == 0 else 0.25]
        assert not any(step.terminated for step in steps)


def test_slip_goes_the_other_way() -> None:
    """slip 0.2 in a row of 3: left from the middle is 0.8 to 0 and 0.2 to 2; at the wall 0.8 stays."""
    transition = chain_ends(MdpConfig(states=3, slip=0.2))[0].transition
    np.testing.assert_allclose(transition[1, 0], [0.8, 0, 0.2])
    np.testing.assert_allclose(transition[1, 1], [0.2, 0, 0.8])
    np.testing.assert_allclose(transition[0, 0], [0.8, 0.2, 0])
    np.testing.assert_allclose(transition[2, 1], [0, 0.2, 0.8])


def test_budgets_of_the_chain_are_half_the_signals_steps() -> None:
    """R changes by |s_{t+1} - s_t| / 2 at both ends of the row, P never."""
    signal = [0.0, 1.0, 0.4, -2.0, -1.5]  # clipped: 0, 1, 0.4, -1, -1
    b_r, b_p = Chain(lambda t: signal[t], MdpConfig(states=5), seed=0).budgets(4)
    np.testing.assert_allclose(b_r, [0.5, 0.3, 0.7, 0.0], atol=1e-12)
    np.testing.assert_array_equal(b_p, 0.0)


@pytest.mark.parametrize("world", [RandomMdp, Chain])
def test_too_many_states_are_refused(world: type[RandomMdp | Chain]) -> None:
    with pytest.raises(ConfigError, match=r"env\.mdp\.states = 2000: .*1,000,000"):
        world(ramp, MdpConfig(states=2000, actions=2), seed=0)
