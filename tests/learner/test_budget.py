"""The update-to-data limit, counted by hand."""

from __future__ import annotations

import pytest

from learner.budget import TableBudget, UpdateBudget
from rtcore.config import LearnerConfig
from rtcore.messages import Phase


def spend_all(budget: UpdateBudget, phase: Phase = "update") -> int:
    steps = 0
    while budget.allows(phase):
        budget.spend()
        steps += 1
    return steps


def test_nothing_before_learning_starts_then_utd_per_transition() -> None:
    budget = UpdateBudget(LearnerConfig(utd=2.0, learning_starts=10))
    budget.earn(9, "update")
    assert spend_all(budget) == 0
    budget.earn(4, "update")  # 13 in all: 3 beyond the start
    assert spend_all(budget) == 6


def test_a_fraction_adds_up() -> None:
    budget = UpdateBudget(LearnerConfig(utd=0.25, learning_starts=0))
    made = []
    for _ in range(8):
        budget.earn(1, "update")
        made.append(spend_all(budget))
    assert made == [0, 0, 0, 1, 0, 0, 0, 1]


@pytest.mark.parametrize(("share", "steps"), [("full", 8), ("half", 4), ("off", 0)])
def test_a_hold_earns_its_share_and_leaves_no_debt(share: str, steps: int) -> None:
    budget = UpdateBudget(LearnerConfig(utd=1.0, learning_starts=0, hold_learning=share))  # type: ignore[arg-type]
    budget.earn(8, "hold")
    assert spend_all(budget) == steps
    budget.earn(3, "update")
    assert spend_all(budget) == 3


def test_what_a_slow_learner_has_left_is_not_spent_in_a_hold_that_is_off() -> None:
    budget = UpdateBudget(LearnerConfig(utd=1.0, learning_starts=0, hold_learning="off"))
    budget.earn(8, "update")
    assert spend_all(budget, "hold") == 0
    assert spend_all(budget, "update") == 8


def test_a_resumed_learner_does_not_wait_again() -> None:
    budget = UpdateBudget(LearnerConfig(utd=1.0, learning_starts=10))
    budget.resume(7, 0.0, 0)
    budget.earn(5, "update")
    assert spend_all(budget) == 2


def test_what_is_not_in_the_checkpoint_is_spent_again() -> None:
    """50 steps earned, 40 of them in the checkpoint, 8 more lost with the learner that made them."""
    budget = UpdateBudget(LearnerConfig(utd=0.5, learning_starts=0))
    budget.resume(100, 50.0, 40)
    assert spend_all(budget) == 10
    budget.earn(4, "update")
    assert (budget.earned, budget.spent) == (52.0, 50)


def test_a_checkpoint_that_knows_more_than_the_replay_leaves_no_debt() -> None:
    budget = UpdateBudget(LearnerConfig(utd=1.0, learning_starts=0))
    budget.resume(0, 40.0, 60)
    budget.earn(3, "update")
    assert spend_all(budget) == 3


def test_a_table_goes_on_until_an_update_finds_nothing_new() -> None:
    budget = TableBudget(LearnerConfig(algo="q", utd=0.1, learning_starts=1000))
    assert budget.allows("update")  # an earlier learner may have left something
    budget.spend(1000)
    assert budget.allows("hold")
    budget.spend(0)
    assert not budget.allows("update")
    budget.earn(0, "update")
    assert not budget.allows("update")
    budget.earn(1, "hold")
    assert budget.allows("hold")


def test_what_a_table_may_not_learn_in_a_hold_waits_for_the_next_update_phase() -> None:
    budget = TableBudget(LearnerConfig(algo="q", hold_learning="off"))
    budget.earn(5, "hold")
    assert not budget.allows("hold")
    assert budget.allows("update")
