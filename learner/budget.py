"""How much the learner may learn: the update-to-data limit of gradient steps; of a table, all that came."""

from __future__ import annotations

from rtcore.config import LearnerConfig
from rtcore.messages import Phase

SHARE = {"full": 1.0, "half": 0.5, "off": 0.0}


class UpdateBudget:
    """Earned by transitions, spent by gradient steps.

    Each transition after the first `learning_starts` earns `utd` steps; in a hold, `hold_learning`'s
    share of it, so that "off" leaves no debt to be worked off when the next window begins. What a
    learner that is too slow has not spent, it may spend later, but never in a hold that is "off".
    """

    def __init__(self, config: LearnerConfig) -> None:
        self._utd = config.utd
        self._waiting = config.learning_starts
        self._hold_share = SHARE[config.hold_learning]
        self._credit = 0.0

    def resume(self, transitions: int) -> None:
        """Count in what an earlier learner left in the replay; it is no reason for new steps."""
        self._waiting = max(0, self._waiting - transitions)

    def earn(self, transitions: int, phase: Phase) -> None:
        """Take note of new transitions in the replay."""
        late = max(0, transitions - self._waiting)
        self._waiting -= transitions - late
        self._credit += late * self._utd * (1.0 if phase == "update" else self._hold_share)

    def allows(self, phase: Phase) -> bool:
        """Whether one more gradient step may be made in this phase."""
        return self._credit >= 1.0 and (phase == "update" or self._hold_share > 0.0)

    def spend(self, steps: int = 1) -> None:
        """So many gradient steps were made."""
        self._credit -= steps


class TableBudget:
    """A table learns from each transition once, as it comes; update-to-data limits mean nothing to it.

    In a hold with `hold_learning` "off" nothing is learned; what came is learned in the next update phase.
    """

    def __init__(self, config: LearnerConfig) -> None:
        self._hold_share = SHARE[config.hold_learning]
        self._waiting = True  # an earlier learner may have left something

    def resume(self, transitions: int) -> None:
        """What an earlier learner left is looked for anyway."""

    def earn(self, transitions: int, phase: Phase) -> None:
        """Take note of new transitions in the replay."""
        del phase
        self._waiting |= transitions > 0

    def allows(self, phase: Phase) -> bool:
        """Whether there may be something to learn in this phase."""
        return self._waiting and (phase == "update" or self._hold_share > 0.0)

    def spend(self, steps: int = 1) -> None:
        """So many transitions were learned; none: nothing waits any more."""
        self._waiting = steps > 0
