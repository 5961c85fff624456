from __future__ import annotations

import pytest

from launcher.restarts import Again, GiveUp, Restarts, describe
from rtcore.channels import AGENT, LEARNER
from rtcore.config import SuperviseConfig

CONFIG = SuperviseConfig(limit=3, within_s=60.0, first_s=0.1, most_s=0.3)


def test_the_delay_doubles_up_to_the_most_and_then_the_run_is_given_up() -> None:
    restarts = Restarts(CONFIG)
    # 0.1, 0.2, then 0.4 > 0.3; the fourth death in a row is one more than the limit.
    assert [restarts.died(AGENT, float(n), -9) for n in range(3)] == [Again(0.1), Again(0.2), Again(0.3)]
    why = "died 4 times in a row (3 x signal SIGKILL, exit code 1)"
    assert restarts.died(AGENT, 3.0, 1) == GiveUp(why)


def deaths_until_given_up(life_s: float, *, hung: bool = False) -> int:
    """How often a process is let die whose every life lasts so long; 0: it is never given up."""
    restarts, now_s = Restarts(SuperviseConfig()), 0.0
    for death in range(1, 100):
        now_s += life_s
        verdict = restarts.died(LEARNER, now_s, -9, hung=hung)
        if isinstance(verdict, GiveUp):
            return death
        now_s += verdict.delay_s
    return 0


@pytest.mark.parametrize("life_s", [0.0, 3.6, 8.0, 59.9])
def test_short_lives_in_a_row_are_given_up_however_long_they_take_together(life_s: float) -> None:
    assert deaths_until_given_up(life_s) == 11


@pytest.mark.parametrize("life_s", [8.0, 60.2])  # it hung at once; it hung before its first turn
def test_who_hangs_again_and_again_is_given_up(life_s: float) -> None:
    assert deaths_until_given_up(life_s, hung=True) == 11


def test_a_life_that_lasted_begins_the_count_anew() -> None:
    assert deaths_until_given_up(60.0) == 0
    assert deaths_until_given_up(120.0, hung=True) == 0
    restarts = Restarts(CONFIG)
    assert [restarts.died(AGENT, now_s, 1) for now_s in (100.0, 101.0)] == [Again(0.1), Again(0.2)]
    # That life began at 101.2 s: 59.9 s are too few, 60 s are enough.
    assert restarts.died(AGENT, 161.1, 1) == Again(0.3)
    assert restarts.died(AGENT, 221.4, 1) == Again(0.1)


def test_each_process_has_its_own_count() -> None:
    restarts = Restarts(CONFIG)
    for n in range(3):
        assert isinstance(restarts.died(AGENT, float(n), 1), Again)
    assert restarts.died(LEARNER, 3.0, 1) == Again(0.1)


@pytest.mark.parametrize("limit", [0, 10])
def test_wrong_input_is_never_started_again(limit: int) -> None:
    found = Restarts(SuperviseConfig(limit=limit)).died(LEARNER, 0.0, 2)
    assert found == GiveUp("cannot work with what it was given (exit code 2)")


def test_without_restarts_the_first_death_is_the_last() -> None:
    restarts = Restarts(SuperviseConfig(limit=0))
    assert restarts.died(AGENT, 0.0, -9) == GiveUp("ended unexpectedly (signal SIGKILL)")
    assert restarts.died(LEARNER, 0.0, -9, hung=True) == GiveUp("ended unexpectedly (hung and was killed)")


def test_no_limit_makes_a_delay_that_cannot_be_computed() -> None:
    restarts = Restarts(SuperviseConfig(limit=10_000))
    found = [restarts.died(AGENT, 0.0, 1) for _ in range(5_000)]
    assert found[-1] == Again(5.0)


def test_codes_in_words() -> None:
    assert [describe(code) for code in (0, 3, -15, -40)] == [
        "exit code 0",
        "exit code 3",
        "signal SIGTERM",
        "signal 40",
    ]
