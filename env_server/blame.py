"""Why a deadline was missed: judged from the stamps along its causal chain, once they are known.

At D_k the env server knows only that the answer to observation e, that of the tick executed before, is not
there. Why becomes known when the answer comes after all, or one to a later observation:

    D_e       sent       received        sent     arrived
     | env     | transport  | agent        | transport |      D_k lies before `arrived`: a miss
     '---------'------------'--------------'-----------'

A process that was stopped, or was not there, is to blame for what it kept from happening. Otherwise the
longest link of the chain is: of the agent's own, parts belong to the policy's swap, to the collector, and
to a wait for a core. `judge` is pure; `Blame` holds the log back until the verdict.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec

from rtcore.bus import Received
from rtcore.messages import Action, MissCause, Step

ABSENT_NS = 1_000_000_000  # silent for longer than this, the agent counts as absent

VERDICTS_PER_TICK = 8  # after a long stall hundreds are due at once; one takes 10 to 20 us
MEMORY = 256  # messages remembered while a verdict is open


@dataclass(frozen=True, slots=True)
class Miss:
    """A deadline D_k without an answer, in ns of the env server's clock.

    Attributes:
        tick: e, whose observation was to be answered.
        due_ns: D_e.
        sent_ns: when that observation left.
        missed_ns: D_k.
        woke_ns: when the env server looked for the answer, at or after D_k.
        over_ns: when it had dealt with tick k.
        invalid: an answer had come, but one that cannot act.
    """

    tick: int
    due_ns: int
    sent_ns: int
    missed_ns: int
    woke_ns: int
    over_ns: int
    invalid: bool = False


@dataclass(frozen=True, slots=True)
class Answer:
    """A message of the agent's, with its stamps on the env server's clock. See `Action`."""

    tick: int
    received_ns: int
    sent_ns: int
    arrived_ns: int
    swap_ns: int = 0
    collector_ns: int = 0
    starved_ns: int = 0
    resumed_ns: int = 0
    since_ns: int = 0

    @staticmethod
    def of(received: Received[Action], observed_ns: int | None) -> Answer:
        """An answer as it came.

        Args:
            received: the message.
            observed_ns: when the observation that it answers was sent; None: too long ago.

        A host's stamps are in order: observed, received, sent, arrived. Where they are not, the agent is on
        another host, and its clock is set so that the way out and the way back take equally long.
        """
        action, arrived_ns = received.message, received.received_ns
        shift_ns = 0
        if observed_ns is not None and not observed_ns <= action.received_ns <= action.sent_ns <= arrived_ns:
            shift_ns = (observed_ns + arrived_ns - action.received_ns - action.sent_ns) // 2
        return Answer(
            action.tick,
            action.received_ns + shift_ns,
            action.sent_ns + shift_ns,
            arrived_ns,
            action.swap_ns,
            action.collector_ns,
            action.starved_ns,
            action.resumed_ns + shift_ns if action.resumed_ns else 0,
            action.since_ns + shift_ns if action.since_ns else 0,
        )


def judge(miss: Miss, answers: Sequence[Answer], resumed_ns: Sequence[int] = ()) -> MissCause:
    """The cause of a miss.

    Args:
        miss: the deadline.
        answers: the agent's messages in the order of their coming; those from before the observation was
            sent do no harm.
        resumed_ns: when the env server's own process was continued after a stop.
    """
    if miss.invalid:
        return "agent_late"  # with a right one
    if any(miss.due_ns < at <= miss.over_ns for at in resumed_ns):
        return "env_late"
    answer = next((answer for answer in answers if answer.tick >= miss.tick), None)
    if answer is None or answer.since_ns > miss.sent_ns:
        return "agent_absent"  # not there, or started only afterwards
    if any(_stopped(miss, answers, at) for at in {answer.resumed_ns for answer in answers}):
        return "agent_stalled"
    shares = _shares(miss, answers)
    return max(shares, key=lambda cause: shares[cause])


def _stopped(miss: Miss, answers: Sequence[Answer], resumed_ns: int) -> bool:
    """Whether the stop of the agent that ended at `resumed_ns` fell between the observation's leaving and
    the deadline: it did unless the agent was at work after the deadline and before the stop's end.
    """
    between = (miss.woke_ns <= answer.sent_ns < resumed_ns for answer in answers)
    return resumed_ns > miss.sent_ns and not any(between)


def _shares(miss: Miss, answers: Sequence[Answer]) -> Counter[MissCause]:
    """Who had how much of the time from D_e until the answer, or one to a later observation, arrived; ns.

    Of equal shares the first counts, in the order below.
    """
    shares: Counter[MissCause] = Counter({"env_late": miss.sent_ns - miss.due_ns})
    done_ns = miss.sent_ns
    for answer in answers:
        waiting_ns = max(0, min(answer.received_ns, answer.sent_ns) - done_ns)
        busy_ns = max(0, answer.sent_ns - done_ns) - waiting_ns
        # A thread waits for a core above all when it is woken to receive; the others keep it from acting.
        stalled_ns, waiting_ns, busy_ns = _take(answer.starved_ns, waiting_ns, busy_ns)
        paused_ns, busy_ns, waiting_ns = _take(answer.collector_ns, busy_ns, waiting_ns)
        swapped_ns, busy_ns, waiting_ns = _take(answer.swap_ns, busy_ns, waiting_ns)
        shares["agent_stalled"] += stalled_ns
        shares["collector_pause"] += paused_ns
        shares["policy_swap"] += swapped_ns
        shares["agent_late"] += busy_ns
        shares["transport"] += waiting_ns
        done_ns = max(done_ns, answer.sent_ns)
        if answer.tick >= miss.tick:
            # Sent, but not arrived: what of it the env server slept over is its own.
            asleep_ns = max(0, miss.woke_ns - max(miss.missed_ns, done_ns))
            shares["env_late"] += asleep_ns
            shares["transport"] += answer.arrived_ns - done_ns - asleep_ns
            break
    return shares


def _take(amount: int, first: int, second: int) -> tuple[int, int, int]:
    """Take `amount` from `first`, then from `second`, as far as it goes: what was taken, and what is left."""
    from_first = min(amount, first)
    from_second = min(amount - from_first, second)
    return from_first + from_second, first - from_first, second - from_second


@dataclass(frozen=True, slots=True)
class _Case:
    """A step that waits; `miss` is None if its deadline was kept."""

    step: Step
    miss: Miss | None
    entered: int  # ticks executed until then


class Blame:
    """Holds steps back, in order, from the first miss without a verdict on.

    A verdict takes until the observation, or a later one, is answered: a tick where all is well again; or
    until the agent has been silent for a second. An agent that is absent holds nothing back.

    Args:
        tick_ns: the control period.
        resumed_ns: gives the instants at which this process was continued after a stop.
    """

    def __init__(self, tick_ns: int, resumed_ns: Callable[[], Sequence[int]] = tuple) -> None:
        self._patience_ticks = max(2, math.ceil(ABSENT_NS / tick_ns))
        self._resumed_ns = resumed_ns
        self._cases: deque[_Case] = deque()
        self._heard: deque[tuple[Received[Action], int | None]] = deque(maxlen=MEMORY)
        self._entered = 0
        self._silent_ticks: int | None = None  # executed since the last message; None: there was none yet

    @property
    def absent(self) -> bool:
        """Whether the agent was never heard, or not for a second (and two ticks)."""
        return self._silent_ticks is None or self._silent_ticks > self._patience_ticks

    @property
    def open(self) -> bool:
        """Whether steps are held back."""
        return bool(self._cases)

    def notice(self) -> None:
        """The agent said something."""
        self._silent_ticks = -1  # 0 at the end of this tick

    def hear(self, received: Received[Action], observed_ns: int | None) -> None:
        """The agent answered an observation; in the order of their coming. See `Answer.of`."""
        self.notice()
        self._heard.append((received, observed_ns))

    def enter(self, step: Step, miss: Miss | None) -> list[Step]:
        """Take the next executed tick, after what was heard until its deadline.

        Returns:
            Steps about which nothing is open any more, oldest first.
        """
        self._entered += 1
        if self._silent_ticks is not None:
            self._silent_ticks += 1
        if miss is None and not self._cases:
            while len(self._heard) > 1:  # the last one may tell what kept it from the next observation
                self._heard.popleft()
            return [step]
        self._cases.append(_Case(step, miss, self._entered))
        return self._release(VERDICTS_PER_TICK, final=False)

    def finish(self) -> list[Step]:
        """Nothing follows: judge by what is known. A miss after which nothing was heard is `agent_absent`."""
        return self._release(len(self._cases), final=True)

    def _release(self, num_verdicts: int, *, final: bool) -> list[Step]:
        due: list[Step] = []
        while self._cases:
            case = self._cases[0]
            if case.miss is None:
                due.append(case.step)
            elif num_verdicts and (final or self._is_ripe(case.miss, self._entered - case.entered)):
                num_verdicts -= 1
                due.append(self._judged(case.step, case.miss))
            else:
                break
            self._cases.popleft()
        return due

    def _is_ripe(self, miss: Miss, ticks_since: int) -> bool:
        if self.absent or ticks_since > self._patience_ticks:
            return True
        return any(received.message.tick >= miss.tick for received, _ in self._heard)

    def _judged(self, step: Step, miss: Miss) -> Step:
        while self._heard and self._heard[0][0].received_ns < miss.due_ns:
            self._heard.popleft()  # nor will it say anything about a later miss
        answers = [Answer.of(received, observed_ns) for received, observed_ns in self._heard]
        return msgspec.structs.replace(step, cause=judge(miss, answers, self._resumed_ns()))
