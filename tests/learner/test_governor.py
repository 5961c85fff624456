"""The governor on hand-made logs at 100 Hz: a window of evidence is 500 ticks, 1 % of it 5."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from learner.governor import Decision, Governor, Power, ladder
from rtcore.messages import MissCause, Step

TICK_NS = 10_000_000
MS = 1_000_000


class Log:
    """Makes ticks one after the other and feeds each to the governor as it happens."""

    def __init__(self, threads: int = 1, envs: Sequence[str] = ("env0",)) -> None:
        self.governor = Governor(threads, TICK_NS, envs)
        self.seq = 0
        self.delay_ns = 0  # from a tick to the learner's hearing of it

    def tick(self, *, busy: bool = True, **fields: Any) -> Decision | None:
        """One more tick, as `step` has it; `busy`: the learner worked meanwhile."""
        due_ns = self.work(busy=busy)
        return self.governor.feed([self.step("env0", **fields)], due_ns + self.delay_ns)

    def work(self, *, busy: bool = True) -> int:
        """A period passes; returns its end."""
        self.seq += 1
        due_ns = self.seq * TICK_NS
        if busy:
            self.governor.worked(due_ns - TICK_NS, due_ns)
        return due_ns

    def step(
        self,
        env: str,
        *,
        sent_ms: float = 1.0,
        loop_ms: float = 2.0,
        cause: MissCause = "",
        skipped: int = 0,
        reset: bool = False,
        incarnation: int = 7,
    ) -> Step:
        """What the log says of the newest period; the step left `sent_ms` after its deadline."""
        due_ns = self.seq * TICK_NS
        return Step(
            env=env, incarnation=incarnation, seq=self.seq, tick=self.seq, episode=0,
            episode_tick=0 if reset else self.seq, unit=0, due_ns=due_ns, woke_ns=due_ns,
            sent_ns=due_ns + round(sent_ms * MS), observation=b"", reward=0.0, terminated=False,
            truncated=False, action=b"", decision=b"", answered_tick=self.seq - 1, policy_version=0,
            missed=cause != "", fallback="", cause=cause, skipped=skipped,
            loop_ns=-1 if cause else round(loop_ms * MS), reaction_ns=-1, drift=0.0, position=b"",
        )  # fmt: skip

    def quiet(self, ticks: int, *, busy: bool = True) -> list[tuple[int, Power]]:
        """Untroubled ticks: which of them, from 1, brought a decision, and to what."""
        decisions = ((n, self.tick(busy=busy)) for n in range(1, ticks + 1))
        return [(n, decision.power) for n, decision in decisions if decision is not None]

    def stall(self) -> Decision | None:
        """Two runs of lost deadlines, a tick each; the decision, if there is one, comes with the last."""
        causes: tuple[MissCause, ...] = ("", "agent_late", "", "agent_late")
        for cause in causes:
            decision = self.tick(cause=cause)
            if decision is not None:
                return decision
        return None


HALF = Power(1, 0.5)


def test_the_ladder_halves_threads_first_and_then_the_duty() -> None:
    duties = [Power(1, 1.0), Power(1, 0.5), Power(1, 0.25), Power(1, 0.125)]
    assert list(ladder(1)) == duties
    assert list(ladder(2)) == [Power(2), *duties]
    assert list(ladder(6)) == [Power(6), Power(3), *duties]


def test_without_trouble_nothing_happens() -> None:
    log = Log()
    assert log.quiet(1000) == []
    assert log.governor.power == Power(1)
    assert log.governor.load == pytest.approx(0.3)  # 1 ms until the step left, 2 ms for the answer


def test_in_virtual_time_nothing_happens() -> None:
    log = Log()
    assert all(log.tick(sent_ms=0.0, loop_ms=0.0, busy=False) is None for _ in range(1000))
    assert log.governor.load == 0.0


def test_it_is_the_99th_percentile_that_counts() -> None:
    log = Log()
    log.quiet(490)
    for _ in range(5):
        assert log.tick(loop_ms=7.1) is None  # 8.1 of 10 ms are more than 80 %
    assert log.tick(loop_ms=7.0) is None  # 8.0 are not
    decision = log.tick(loop_ms=7.5)
    assert decision == Decision(
        HALF, "1 thread, 1/2 duty: p99 of the loop took 81% of the period, deadlines lost 0 times"
    )


def test_what_is_older_than_five_seconds_is_forgotten() -> None:
    log = Log()
    log.quiet(10)
    for _ in range(5):
        log.tick(loop_ms=8.0)
    log.quiet(496)
    assert [log.tick(loop_ms=8.0) for _ in range(4)] == [None] * 4  # beside one that is still in the window


def test_a_run_of_misses_is_one_stall_and_a_second_one_is_a_pattern() -> None:
    log = Log()
    log.quiet(10)
    assert [log.tick(cause="agent_late") for _ in range(4)] == [None] * 4
    assert log.tick() is None
    decision = log.tick(cause="transport")
    assert decision is not None
    assert decision.power == HALF
    assert decision.text.endswith("p99 of the loop took 100% of the period, deadlines lost 2 times")


def test_an_overslept_deadline_is_lost() -> None:
    log = Log()
    log.quiet(10)
    log.tick(skipped=3)
    log.tick()
    decision = log.tick(skipped=1)
    assert decision is not None and decision.power == HALF


@pytest.mark.parametrize(
    ("cause", "gives_way"),
    [
        ("agent_late", True),
        ("agent_stalled", True),
        ("transport", True),
        ("env_late", True),
        ("agent_absent", False),
        ("policy_swap", False),
        ("collector_pause", False),
    ],
)
def test_only_what_the_learner_may_have_caused_counts(cause: MissCause, *, gives_way: bool) -> None:
    log = Log()
    for _ in range(10):
        log.tick(cause=cause)
        log.tick()
    assert (log.governor.power != Power(1)) == gives_way


def test_what_happens_while_the_learner_rests_is_not_its_doing() -> None:
    log = Log()
    for _ in range(50):
        assert log.tick(cause="agent_late", busy=False) is None
        assert log.tick(busy=False) is None


def test_resets_gaps_and_new_incarnations_say_nothing() -> None:
    log = Log()
    for incarnation in range(50):
        assert log.tick(reset=True, loop_ms=9.9, incarnation=7) is None
        assert log.tick(loop_ms=9.9, incarnation=8 + incarnation) is None
        log.seq += 1
        assert log.tick(loop_ms=9.9, incarnation=8 + incarnation) is None


def test_trouble_takes_it_down_step_by_step_and_never_to_nothing() -> None:
    log = Log(threads=2)
    assert log.quiet(250)[-1][1] == Power(2)
    decisions = [log.stall() for _ in range(6)]
    assert [None if one is None else one.power for one in decisions] == [
        Power(1), HALF, Power(1, 0.25), Power(1, 0.125), None, None,
    ]  # fmt: skip


def test_a_second_thread_is_earned() -> None:
    log = Log(threads=2)
    assert log.governor.power == Power(1)
    assert log.quiet(500) == [(201, Power(2))]  # two seconds; the first tick has none before it
    idle = Log(threads=2)
    assert idle.quiet(1000, busy=False) == []  # a learner that does nothing earns nothing


def test_ticks_from_before_a_decision_are_no_evidence_on_it() -> None:
    log = Log()
    log.quiet(10)
    log.stall()
    decided_ns = log.seq * TICK_NS
    late = Log()  # the same ticks, but in batches: the decision comes when three further ones have begun
    late.quiet(10)
    late.delay_ns = 3 * TICK_NS
    late.stall()
    late.delay_ns = 0
    assert late.seq * TICK_NS == decided_ns
    # The stall's four ticks: three had begun before the decision, the fourth alone is not enough.
    assert late.stall() is None and late.governor.power == HALF
    assert log.stall() is not None and log.governor.power == Power(1, 0.25)


def test_patience_doubles_up_to_64_seconds_and_begins_anew_after_a_good_while() -> None:
    log = Log(threads=2)
    waits = []
    for _ in range(8):
        waits.append(next(n for n in range(1, 20_000) if log.tick() is not None))
        log.stall()  # at once
    # Of the first tick of all the one before is unknown; after a stall there is nothing to wait for.
    assert waits == [201, 400, 800, 1600, 3200, 6400, 6400, 6400]
    log.quiet(6400 + 6400 + 500)  # back at full power, and 69 s of peace
    log.stall()
    assert log.quiet(300) == [(200, Power(2))]


def test_going_down_several_levels_at_once_is_one_failure() -> None:
    log = Log(threads=2)
    log.quiet(250)
    for _ in range(4):
        log.stall()
    assert log.governor.power == Power(1, 0.125)
    # 4 s, not 2, because two threads were too much too early, and not 32; at 1/8 duty, 50 busy ticks are 4 s
    assert log.quiet(500) == [(50, Power(1, 0.25)), (150, HALF), (350, Power(1))]


def test_half_the_duty_earns_at_half_the_pace() -> None:
    log = Log()
    log.quiet(10)
    log.stall()
    found = [n for n in range(1, 300) if log.tick(busy=n % 2 == 0) is not None]
    assert found == [200]  # with the 100th busy tick: half of two seconds


def test_if_giving_way_does_not_help_it_takes_everything_back_for_a_minute() -> None:
    log = Log()
    log.quiet(10)
    log.stall()
    decisions: list[Decision] = []
    for n in range(1, 400):  # every seventh tick is tight, whether the learner works or not
        decision = log.tick(busy=n * log.governor.power.duty % 1 == 0, loop_ms=8.5 if n % 7 == 0 else 2.0)
        decisions += [decision] if decision is not None else []
        if log.governor.power == Power(1):
            break
    assert [decision.power for decision in decisions] == [Power(1, 0.25), Power(1)]  # 1/2 had too few pauses
    assert decisions[-1].text == (
        "1 thread, full duty: giving way would not help: 14.3% of the ticks tight beside it, 14.3% without"
    )
    begin = log.seq
    while log.tick(loop_ms=8.5 if log.seq % 4 == 0 else 2.0) is None:  # 25 % is less than twice as bad
        pass
    assert log.governor.power == HALF
    assert log.seq - begin == 6000


def test_a_verdict_of_in_vain_ends_early_when_it_gets_twice_as_bad() -> None:
    log = Log()
    decision = None
    for n in range(1, 200):  # a learner with little to do: it works in every fourth tick
        decision = log.tick(busy=n % 4 == 0, loop_ms=8.5 if n % 7 == 0 else 2.0)
        if decision is not None:
            break
    assert decision is not None and decision.power == Power(1) and "would not help" in decision.text
    begin = log.seq
    while log.tick(loop_ms=8.5 if log.seq % 3 == 0 else 2.0) is None:
        pass
    assert log.governor.power == HALF
    assert log.seq - begin == 250  # half a window


def test_while_it_helps_it_goes_on_giving_way() -> None:
    log = Log()
    log.quiet(10)
    log.stall()
    for n in range(1, 2000):  # every seventh tick beside the learner is tight, and no other
        busy = n * log.governor.power.duty % 1 == 0
        log.tick(busy=busy, loop_ms=8.5 if busy and n % 7 == 0 else 2.0)
    assert log.governor.power == Power(1, 0.125)


def test_without_an_env_server_it_stays_as_it_is() -> None:
    log = Log()
    log.quiet(10)
    log.stall()
    assert log.governor.feed([], log.seq * TICK_NS + 3600 * 10**9) is None
    assert log.governor.power == HALF
