"""The pairs of env server and agent on a machine, and the cores that they share."""

from __future__ import annotations

import math
from dataclasses import dataclass

# What one tick of a pair takes of a core: 0.34 ms with four pairs at 500 Hz on two quiet cores, twice that
# beside a full load.
TICK_S = 400e-6
# How much of a core is promised. Beside a full load, four pairs at 500 Hz lost 38 % of their deadlines on one
# core, which is 0.8 by this reckoning, and missed nearly all others; on two cores, 0.4 each, they lost less
# than 1 %, and missed 1 to 25 %.
PROMISED = 0.5


@dataclass(frozen=True, slots=True)
class Crew:
    """The pairs on this machine, and which of them a process belongs to.

    Attributes:
        number: of the pair, from 0.
        count: of pairs.
        hz: control rate of each.
    """

    number: int = 0
    count: int = 1
    hz: float = 0.0

    def cores(self, available: int) -> int:
        """How many of the `available` cores the pairs share: as few as carry them, so that the others stay
        free for learning."""
        wanted = math.ceil(self.count * self.hz * TICK_S / PROMISED)
        return max(1, min(wanted, self.count, available))

    def fills(self, available: int) -> bool:
        """Whether the pairs have each of several cores, so that none is left for learning alone."""
        return 1 < available == self.cores(available)


ALONE = Crew()
