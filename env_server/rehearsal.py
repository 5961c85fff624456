"""Keeping the act path warm: shortly before a deadline the last step is sent once more, as a rehearsal.

Between two ticks the core halts and its caches go to others, so the slow part of a tick is finding its code
and data again. Rehearsed a moment before, the same way is half as long. Measured on two cores under
SCHED_FIFO with a 64x64 policy, the way of an observation to the agent, its answer, and the way back, p50 in
us, without and with rehearsals: 204 + 150 + 144 and 135 + 91 + 120 at 200 Hz, 110 + 90 + 96 and
78 + 48 + 70 at 500 Hz; p99 of their sum 745 and 683, 762 and 330. At 1 kHz p50 went from 262 to 230, and in
eight runs of 5 s by turns there were 712 misses without and 218 with rehearsals, on a noisy host.
"""

from __future__ import annotations

import msgspec

from rtcore.bus import Publisher
from rtcore.clock import Clock
from rtcore.messages import Step

LONGEST_TICK_NS = 200_000_000  # beyond it a wait would make the env server deaf to a stop
SHORTEST_TICK_NS = 1_000_000  # a loop takes 0.2 to 0.3 ms there; above there is no room
# How long before the deadline: a rehearsal takes as long as a cold loop, 0.5 to 0.7 ms at 200 Hz, and must be
# over when the deadline comes. 0.5 ms gave the same p50 there, but a p99 as without.
LEAD_SHARE, LONGEST_LEAD_NS = 0.4, 1_200_000


class Rehearsal:
    """Sends rehearsals; the agent answers them like steps, and the env server ignores the answers."""

    def __init__(self, steps: Publisher[Step], clock: Clock, tick_ns: int, *, fleet: bool = False) -> None:
        """`fleet`: other pairs of env server and agent keep the core busy, and need it."""
        self._steps = steps
        self._clock = clock
        self._tick_ns = tick_ns
        self._lead_ns = round(min(LEAD_SHARE * tick_ns, LONGEST_LEAD_NS))
        self.wanted = not fleet and SHORTEST_TICK_NS <= tick_ns <= LONGEST_TICK_NS

    def perform(self, step: Step) -> bool:
        """Wait for the moment before the deadline that follows `step`, and send it once more.

        Returns:
            False if that moment has passed, and nothing was sent.
        """
        at_ns = step.due_ns + self._tick_ns - self._lead_ns
        if not self.wanted or self._clock.now_ns() > at_ns:
            return False
        self._clock.rest_until_ns(at_ns)
        if (
            self._clock.now_ns() > at_ns + self._lead_ns // 2
        ):  # woken late: it would be in the real step's way
            return False
        self._steps.put(msgspec.structs.replace(step, rehearsal=True))
        return True
