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
        self.spent = 0

    @property
    def earned(self) -> float:
        """Steps earned so far, earlier learners of the run included."""
        return self._credit + self.spent

    def resume(self, transitions: int, earned: float, spent: int) -> None:
        """Go on after an earlier learner, which left so many transitions in the replay.

        Args:
            transitions: those that it waited for need not be waited for again.
            earned: by all of them.
            spent: by the steps that are in the algorithm as it was restored; what else was spent is spent
                again, because those steps are lost.
        """
        self._waiting = max(0, self._waiting - transitions)
        self.spent, self._credit = spent, max(0.0, earned - spent)

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
        self.spent += steps


class TableBudget:
    """A table learns from each transition once, as it comes; update-to-data limits mean nothing to it.

    In a hold with `hold_learning` "off" nothing is learned; what came is learned in the next update phase.
    """

    earned, spent = 0.0, 0  # what it has read it knows itself

    def __init__(self, config: LearnerConfig) -> None:
        self._hold_share = SHARE[config.hold_learning]
        self._waiting = True  # an earlier learner may have left something

    def resume(self, transitions: int, earned: float, spent: int) -> None:
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
