"""The governor beside several agents: at 100 Hz a window of evidence is 500 ticks, 1 % of it 5."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from learner.governor import Decision, Power
from rtcore.messages import Step
from tests.learner.test_governor import HALF, Log


class Fleet(Log):
    """Two of them, whose logs come in batches of five ticks, one after the other."""

    def __init__(self) -> None:
        super().__init__(envs=("env0", "env1"))
        self.decided: list[Decision] = []

    def live(self, ticks: int, *, tight_every: int = 0, gone: Sequence[str] = ()) -> None:
        """As many ticks of each that is not `gone`; of env1 every so-manieth is tight."""
        logs: dict[str, list[Step]] = {"env0": [], "env1": []}
        for n in range(1, ticks + 1):
            due_ns = self.work()
            tight = tight_every > 0 and self.seq % tight_every == 0
            logs["env0"].append(self.step("env0"))
            logs["env1"].append(self.step("env1", loop_ms=8.5 if tight else 2.0))
            if n % 5 == 0:
                for env in sorted(logs.keys() - set(gone)):
                    decision = self.governor.feed(logs[env], due_ns)
                    self.decided += [] if decision is None else [decision]
                logs = {"env0": [], "env1": []}


def test_the_worst_of_two_counts() -> None:
    """Six tight ticks of env1 are too many, and take 60 of its ticks."""
    fleet = Fleet()
    fleet.live(55, tight_every=10)
    assert fleet.decided == []
    assert fleet.governor.load == pytest.approx(0.95, abs=0.05)
    fleet.live(5, tight_every=10)
    assert [decision.power for decision in fleet.decided] == [HALF]
    assert fleet.governor.load == 0.0  # what was is no evidence any more


def test_power_comes_back_when_neither_is_in_trouble() -> None:
    fleet = Fleet()
    fleet.live(60, tight_every=10)
    fleet.live(95)  # 2 s at half duty are 100 ticks
    assert len(fleet.decided) == 1
    fleet.live(10)
    assert [decision.power for decision in fleet.decided] == [HALF, Power(1)]
    fleet.live(60, tight_every=10)  # too early: patience doubles
    fleet.live(185)
    assert len(fleet.decided) == 3
    fleet.live(20)
    assert fleet.decided[-1].power == Power(1)


def test_one_in_trouble_keeps_power_from_coming_back() -> None:
    fleet = Fleet()
    fleet.live(1200, tight_every=3)
    assert [decision.power.duty for decision in fleet.decided] == [0.5, 0.25, 0.125]


def test_one_that_is_gone_does_not_keep_power_from_coming_back() -> None:
    fleet = Fleet()
    fleet.live(1200, tight_every=3)
    fleet.live(1500, gone=["env1"])
    assert fleet.governor.power == Power(1)


def test_both_are_judged_by_when_the_learner_worked() -> None:
    """It works in every fourth tick, and env1 is as tight without it: giving way would not help."""
    fleet, decision = Fleet(), None
    for n in range(1, 600):
        due_ns = fleet.work(busy=n % 4 == 0)
        tight = fleet.step("env1", loop_ms=8.5 if n % 7 == 0 else 2.0)
        assert fleet.governor.feed([fleet.step("env0")], due_ns) is None
        decision = fleet.governor.feed([tight], due_ns)
        if decision is not None:
            break
    assert decision is not None and decision.power == Power(1) and "would not help" in decision.text


# -- the learner works in every fourth tick; env0 is as tight without it, in every seventh, env1 is tight
# beside it alone


def beside_little_work(fleet: Fleet, n: int) -> tuple[Step, Step, int]:
    """The n-th ticks of both, and when they are over."""
    due_ns = fleet.work(busy=n % 4 == 0)
    env0 = fleet.step("env0", loop_ms=8.5 if n % 7 == 0 else 2.0)
    return env0, fleet.step("env1", loop_ms=8.5 if n % 4 == 0 else 2.0), due_ns


def test_whom_it_helps_comes_before_whom_it_does_not() -> None:
    """200 ticks of both at once, 50 of them beside the learner: of env0 7 of those are tight and 21 of the
    others, of env1 50 and none."""
    fleet, due_ns = Fleet(), 0
    steps: list[Step] = []
    for n in range(1, 201):
        env0, env1, due_ns = beside_little_work(fleet, n)
        steps += [env0, env1]
    decision = fleet.governor.feed(steps, due_ns)
    assert decision is not None and decision.power == HALF and "would not help" not in decision.text


def test_what_was_given_up_for_one_is_not_taken_back_for_another_whom_it_does_not_help() -> None:
    """Six tight ticks of env1 a level; then there is no less, and env0 has evidence. It counts alone once
    nothing has come of env1 for 5 s."""
    fleet, decided = Fleet(), list[tuple[int, Decision]]()
    for n in range(1, 1201):
        env0, env1, due_ns = beside_little_work(fleet, n)
        for step in (env0,) if n > 600 else (env0, env1):
            decision = fleet.governor.feed([step], due_ns)
            decided += [] if decision is None else [(n, decision)]
    assert [(n, decision.power) for n, decision in decided] == [
        (24, HALF), (48, Power(1, 0.25)), (72, Power(1, 0.125)), (1100, Power(1)),
    ]  # fmt: skip
    assert "would not help" in decided[-1][1].text
