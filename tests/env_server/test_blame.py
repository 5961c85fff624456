"""Whose fault a miss is, stamp by stamp. Period 5 ms; the observation of tick 7, whose deadline is at 0, is
asked about: it left at 0.2 ms, and at 5 ms there was no answer to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import pytest

from env_server.blame import Answer, Blame, Miss, judge
from rtcore.bus import Received
from rtcore.messages import Action, Step
from tests.env_server.test_journal import step

US = 1_000
MS = 1_000_000
PERIOD_NS = 5 * MS
MISS = Miss(tick=7, due_ns=0, sent_ns=200 * US, missed_ns=5 * MS, woke_ns=5 * MS, over_ns=5_100 * US)


def answer(tick: int, received: float, sent: float, arrived: float, **excuses: float) -> Answer:
    """Stamps and excuses in milliseconds."""
    amounts = {f"{name}_ns": round(value * MS) for name, value in excuses.items()}
    return Answer(tick, round(received * MS), round(sent * MS), round(arrived * MS), **amounts)


def test_the_longest_link_of_the_chain_is_to_blame() -> None:
    # left at 0.2, so: env 0.2, out 0.3, agent 6.5, back 0.1
    assert judge(MISS, [answer(7, 0.5, 7.0, 7.1)]) == "agent_late"
    # out 5.8, agent 0.4, back 0.1
    assert judge(MISS, [answer(7, 6.0, 6.4, 6.5)]) == "transport"
    # out 0.3, agent 0.4, back 5.1
    assert judge(MISS, [answer(7, 0.5, 0.9, 6.0)]) == "transport"


def test_the_way_out_and_the_way_back_count_together() -> None:
    # out 2.0, agent 2.5, back 1.0: 3.0 of transport; with a back of 0.4, 2.4
    assert judge(MISS, [answer(7, 2.2, 4.7, 5.7)]) == "transport"
    assert judge(MISS, [answer(7, 2.2, 4.7, 5.1)]) == "agent_late"


def test_an_observation_that_left_late_is_the_env_servers() -> None:
    miss = Miss(tick=7, due_ns=0, sent_ns=4 * MS, missed_ns=5 * MS, woke_ns=5 * MS, over_ns=5 * MS)
    assert judge(miss, [answer(7, 4.2, 5.2, 5.3)]) == "env_late"  # 4.0 against 0.3 and 1.0
    assert judge(miss, [answer(7, 4.2, 9.2, 9.3)]) == "agent_late"  # 4.0 against 0.3 and 5.0


def test_an_answer_that_the_env_server_slept_over_is_its_own_fault() -> None:
    # sent at 0.9, arrived at 9.5; the deadline was at 5.0, but the env server woke at 9.4 and looked in vain:
    # env 0.2 + 4.4, transport 0.3 + 4.1 + 0.1
    miss = Miss(tick=7, due_ns=0, sent_ns=200 * US, missed_ns=5 * MS, woke_ns=9_400 * US, over_ns=9_500 * US)
    assert judge(miss, [answer(7, 0.5, 0.9, 9.5)]) == "env_late"
    # it woke at 9.2: 0.2 + 4.2 against 0.3 + 4.1 + 0.3
    miss = Miss(tick=7, due_ns=0, sent_ns=200 * US, missed_ns=5 * MS, woke_ns=9_200 * US, over_ns=9_500 * US)
    assert judge(miss, [answer(7, 0.5, 0.9, 9.5)]) == "transport"


@pytest.mark.parametrize(("excuse", "cause"), [("swap", "policy_swap"), ("collector", "collector_pause")])
def test_what_the_agent_can_name_counts_apart_from_its_computing(excuse: str, cause: str) -> None:
    # 6.5 ms in the agent's hands: 3.3 of them named leave 3.2, and 3.2 leave 3.3
    assert judge(MISS, [answer(7, 0.5, 7.0, 7.1, **{excuse: 3.3})]) == cause
    assert judge(MISS, [answer(7, 0.5, 7.0, 7.1, **{excuse: 3.2})]) == "agent_late"


def test_a_thread_that_waited_for_a_core_before_it_could_take_the_observation_is_stalled() -> None:
    # 5.8 ms from env server to agent, of which the receiving thread could have run for 5.6
    assert judge(MISS, [answer(7, 6.0, 6.4, 6.5, starved=5.6)]) == "agent_stalled"
    assert judge(MISS, [answer(7, 6.0, 6.4, 6.5, starved=2.0)]) == "transport"  # 2.0 against 3.8 + 0.1
    # preempted while it computed: of 0.3 on the way and 6.5 in its hands, 3.5 leave 3.3; 3.3 leave 3.5
    assert judge(MISS, [answer(7, 0.5, 7.0, 7.1, starved=3.5)]) == "agent_stalled"
    assert judge(MISS, [answer(7, 0.5, 7.0, 7.1, starved=3.3)]) == "agent_late"


def test_an_excuse_counts_for_no_more_time_than_there_was() -> None:
    # 9 ms of swapping before 0.2 ms are no part of these 0.7 ms; 5.1 ms of the way back are more
    assert judge(MISS, [answer(7, 0.5, 0.9, 6.0, swap=9.0)]) == "transport"


def test_while_an_older_observation_is_answered_the_next_one_waits_on_the_same_account() -> None:
    # The answer to 6 was sent at 4.8, 4.5 of it computing since 0.2; 7 itself took 0.2 + 0.4
    older = answer(6, 0.1, 4.8, 4.9)
    assert judge(MISS, [older, answer(7, 5.0, 5.4, 5.5)]) == "agent_late"
    older = answer(6, 0.1, 4.8, 4.9, swap=4.4)
    assert judge(MISS, [older, answer(7, 5.0, 5.4, 5.5)]) == "policy_swap"


def test_without_an_answer_of_its_own_a_later_one_tells() -> None:
    # 7 was never answered. 8 left at 5.1, came at 5.3: nothing says that 7 ever reached the agent
    assert judge(MISS, [answer(8, 5.3, 5.7, 5.8)]) == "transport"
    # ... unless the acting thread had no core until then
    assert judge(MISS, [answer(8, 5.3, 5.7, 5.8, starved=5.0)]) == "agent_stalled"


def test_the_answer_to_an_older_observation_is_not_the_end_of_the_chain() -> None:
    # that to 6 was sent at 0.3; then 0.2 on the way, and 6.5 of computing for 7
    assert judge(MISS, [answer(6, 0.1, 0.3, 0.4), answer(7, 0.5, 7.0, 7.1)]) == "agent_late"


def test_what_was_said_before_the_observation_left_is_not_evidence() -> None:
    before = answer(6, -4.0, 0.1, 0.15, swap=9.0, starved=9.0)
    assert judge(MISS, [before, answer(7, 0.5, 7.0, 7.1)]) == "agent_late"
    assert judge(MISS, [before]) == "agent_absent"


def test_a_stop_of_the_agent_beats_every_share() -> None:
    # continued at 50.0, with 7 at the door; it answers only 16, sent at 45.1
    assert judge(MISS, [answer(16, 50.1, 50.4, 50.5, resumed=50.0)]) == "agent_stalled"
    # stopped while it computed: 7 itself is answered, after all
    assert judge(MISS, [answer(7, 0.5, 50.4, 50.5, resumed=50.0)]) == "agent_stalled"


def test_a_stop_before_or_after_is_no_excuse() -> None:
    late = answer(7, 0.5, 7.0, 7.1)
    assert judge(MISS, [answer(7, 0.5, 7.0, 7.1, resumed=0.1)]) == "agent_late"  # before 7 left
    # late with 7 by itself; stopped after that, until 60
    assert judge(MISS, [late, answer(18, 60.2, 60.5, 60.6, resumed=60.0)]) == "agent_late"


def test_a_stop_of_the_env_server_is_never_put_on_the_agent() -> None:
    late = [answer(7, 0.5, 7.0, 7.1, resumed=6.0)]
    assert judge(MISS, late, [-1, 3 * MS]) == "env_late"
    assert judge(MISS, late, [5_100 * US]) == "env_late"  # while tick 8 was dealt with: woken by it
    assert judge(MISS, late, [0]) == "agent_stalled"  # before D_7 it may have been, not since
    assert judge(MISS, late, [5_101 * US]) == "agent_stalled"


def test_an_agent_that_came_only_later_was_absent() -> None:
    assert judge(MISS, [answer(9, 11.0, 11.2, 11.3, since=11.0)]) == "agent_absent"
    assert judge(MISS, [answer(7, 3.0, 7.0, 7.1, since=3.0)]) == "agent_absent"  # began with 7 itself
    assert judge(MISS, [answer(7, 0.5, 7.0, 7.1, since=0.1)]) == "agent_late"
    assert judge(MISS, []) == "agent_absent"


def test_an_answer_that_cannot_act_is_the_agents_fault() -> None:
    assert judge(replace(MISS, invalid=True), [answer(7, 0.3, 0.4, 0.5)]) == "agent_late"


def received(tick: int, got_ns: int, sent_ns: int, arrived_ns: int, **excuses: int) -> Received[Action]:
    action = Action(
        env="env0",
        incarnation=77,
        tick=tick,
        values=b"",
        policy_version=1,
        received_ns=got_ns,
        sent_ns=sent_ns,
    )
    return Received(msgspec.structs.replace(action, **excuses), arrived_ns)


def test_stamps_of_this_host_are_taken_as_they_are() -> None:
    message = received(7, 110, 150, 180, swap_ns=3, collector_ns=4, starved_ns=5, resumed_ns=90, since_ns=20)
    assert Answer.of(message, 100) == Answer(7, 110, 150, 180, 3, 4, 5, resumed_ns=90, since_ns=20)
    assert Answer.of(message, None) == Answer(7, 110, 150, 180, 3, 4, 5, resumed_ns=90, since_ns=20)


def test_another_hosts_clock_is_set_by_halving_the_way() -> None:
    # sent at 100, arrived at 180, 40 of it in the agent: 20 out and 20 back
    message = received(7, 9_010, 9_050, 180, resumed_ns=8_990, since_ns=8_920)
    assert Answer.of(message, 100) == Answer(7, 120, 160, 180, resumed_ns=100, since_ns=30)
    assert Answer.of(received(7, 9_010, 9_050, 180), 100).resumed_ns == 0  # "never" stays never


class Run:
    """Ticks of 5 ms through `Blame`; each is asked for the observation of the tick before, sent at once."""

    def __init__(self, *, period_ns: int = PERIOD_NS) -> None:
        self.period_ns = period_ns
        self.resumed_ns: list[int] = []
        self.blame = Blame(period_ns, lambda: self.resumed_ns)
        self.tick = -1

    def turn(self, *heard: int, missed: bool = False) -> list[tuple[int, str]]:
        """The next tick, after answers to the observations `heard`, which took no time on the way and came
        right before this tick; what is released, as (tick, cause)."""
        self.tick += 1
        now_ns = self.tick * self.period_ns
        for tick in heard:
            sent_ns = tick * self.period_ns
            self.blame.hear(received(tick, sent_ns, now_ns - 1, now_ns - 1), sent_ns)
        miss = Miss(self.tick - 1, now_ns - self.period_ns, now_ns - self.period_ns, now_ns, now_ns, now_ns)
        return told(self.blame.enter(missing(self.tick, missed), miss if missed else None))


def missing(tick: int, missed: bool) -> Step:
    return msgspec.structs.replace(step(tick), missed=missed)


def told(steps: Sequence[Step]) -> list[tuple[int, str]]:
    return [(one.tick, one.cause) for one in steps]


def test_kept_deadlines_pass_at_once() -> None:
    run = Run()
    assert [run.turn(), run.turn(0), run.turn(1)] == [[(0, "")], [(1, "")], [(2, "")]]
    assert not run.blame.open


def test_a_miss_holds_the_log_back_until_the_next_answer() -> None:
    run = Run()
    run.turn()
    run.turn(0)
    assert run.turn(missed=True) == []  # the answer to 1 is not there
    assert run.blame.open
    assert run.turn(1, missed=True) == [(2, "agent_late")]  # it took from 5 to 15 ms; that to 2 is not there
    assert run.turn(3) == [(3, "agent_late"), (4, "")]  # nor ever will be: the agent was at 1 all its time
    assert not run.blame.open


def test_the_answers_that_come_at_once_settle_everything_at_once() -> None:
    run = Run()
    run.turn()
    run.turn(0)
    run.turn(missed=True)
    run.turn(missed=True)
    assert run.turn(1, 2, 3) == [(2, "agent_late"), (3, "agent_late"), (4, "")]


def test_messages_about_older_observations_are_not_awaited() -> None:
    run = Run()
    for heard in ((), (0,), (1,)):
        run.turn(*heard)
    run.turn(missed=True)  # 2 is open
    assert run.turn(1, 1, missed=True) == []  # twice the same, from before


def test_an_agent_that_was_never_heard_holds_nothing_back() -> None:
    run = Run()
    run.turn()
    assert run.blame.absent
    assert run.turn(missed=True) == [(1, "agent_absent")]


def test_after_a_second_of_silence_the_agent_is_absent_and_what_waited_goes() -> None:
    run = Run()  # 200 ticks a second
    run.turn()
    run.turn(0)
    waiting = [run.turn(missed=True) for _ in range(200)]
    assert waiting == [[]] * 200
    assert run.turn(missed=True) == [(tick, "agent_absent") for tick in range(2, 10)]  # 8 verdicts a tick
    assert run.blame.absent
    released = [tick for _ in range(40) for tick, _ in run.turn(missed=True)]
    assert released == list(range(10, 243))
    assert not run.blame.open
    assert run.turn(missed=True) == [(243, "agent_absent")]
    assert run.turn(242) == [(244, "")]
    assert not run.blame.absent


def test_at_a_slow_rate_two_silent_ticks_are_no_absence() -> None:
    run = Run(period_ns=10_000 * MS)
    run.turn()
    run.turn(0)
    assert [run.turn(missed=True), run.turn(missed=True)] == [[], []]
    assert run.turn(missed=True) == [(2, "agent_absent"), (3, "agent_absent"), (4, "agent_absent")]


def test_words_that_are_no_answers_show_that_the_agent_is_there() -> None:
    run = Run(period_ns=500 * MS)
    run.turn()
    for _ in range(5):
        run.blame.notice()
        run.turn()
    assert not run.blame.absent


def test_the_end_leaves_nothing_open() -> None:
    run = Run()
    run.turn()
    run.turn(0)
    run.turn(missed=True)
    run.turn()
    assert told(run.blame.finish()) == [(2, "agent_absent"), (3, "")]
    assert not run.blame.open


def test_a_stop_of_this_process_is_asked_for_at_the_verdict() -> None:
    run = Run()
    run.turn()
    run.turn(0)
    run.turn(missed=True)
    run.resumed_ns.append(9 * MS)
    assert run.turn(1, 2) == [(2, "env_late"), (3, "")]
