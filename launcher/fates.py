"""What became of the published policies, by the ledgers of the agents' lives. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from rtcore.messages import Stats

FATES = ("adopted", "rejected", "superseded", "unused", "unreceived")  # of a published policy


def fates(published: int, lives: Sequence[Stats]) -> dict[str, int]:
    """Of each `FATES`, and of `received_again`, how many with one agent; `lives` are its ledgers.

    `unused`: ready when the agent ended, or died; `unreceived`: no life of it got it. The last one of a run
    often has one of these two. What the agent got once more has a fate once more, `received_again` of them:
    the newest one after it was started again, and older ones, which it rejects.
    """
    counted: Counter[str] = Counter()
    for life in lives:
        counted.update(life.counters)
    again = _received_again(lives)
    return {
        "adopted": counted["policies.adopted"],
        "rejected": counted["policies.rejected"],
        "superseded": counted["policies.superseded"],
        "unused": counted["policies.unused"] + _died_with_a_policy(lives),
        "unreceived": published - (counted["policies.received"] - again),
        "received_again": again,
    }


def _died_with_a_policy(lives: Iterable[Stats]) -> int:
    """Policies received by a life of the agent that was killed before it could say what became of them."""
    killed = [Counter(life.counters) for life in lives if not life.final]
    known = ("adopted", "rejected", "superseded", "unused")
    return sum(
        max(0, counters["policies.received"] - sum(counters[f"policies.{fate}"] for fate in known))
        for counters in killed
    )


def _received_again(lives: Iterable[Stats]) -> int:
    """Policies that were there before: older than the newest, or what a life of the agent began with and an
    earlier one had.
    """
    newest = again = 0
    for life in sorted(lives, key=lambda one: one.incarnation):
        first = life.counters.get("policies.first", 0)
        again += (0 < first <= newest) + life.counters.get("policies.past", 0)
        newest = max(newest, life.counters.get("policies.newest", 0))
    return again
