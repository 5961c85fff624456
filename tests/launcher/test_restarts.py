from __future__ import annotations

import pytest

from launcher.restarts import Again, GiveUp, Restarts, describe
from rtcore.channels import AGENT, LEARNER
from rtcore.config import SuperviseConfig

CONFIG = SuperviseConfig(limit=3, within_s=60.0, first_s=0.1, most_s=0.3)


def test_the_delay_doubles_up_to_the_most_and_then_the_run_is_given_up() -> None:
    restarts = Restarts(CONFIG)
    # 0.1, 0.2, then 0.4 > 0.3; the fourth death within the minute is one more than the limit.
    assert [restarts.died(AGENT, float(n), -9) for n in range(3)] == [Again(0.1), Again(0.2), Again(0.3)]
    why = "died 4 times within 60 s (3 x signal SIGKILL, exit code 1)"
    assert restarts.died(AGENT, 3.0, 1) == GiveUp(why)


def test_deaths_of_long_ago_do_not_count() -> None:
    restarts = Restarts(CONFIG)
    for minute in range(20):
        assert restarts.died(AGENT, 61.0 * minute, 1) == Again(0.1)
    assert restarts.died(AGENT, 61.0 * 19 + 60.0, 1) == Again(0.2)  # exactly `within_s` ago does


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
