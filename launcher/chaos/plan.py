"""Which fault befalls which process when. Pure: the same seed gives the same faults."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar, get_args

from rtcore.channels import LEARNER, PROCESSES, RECORDER
from rtcore.config import ConfigError

Kind = Literal["kill", "stop", "slow", "fill", "partition"]
KINDS: tuple[Kind, ...] = get_args(Kind)
Deed = Literal["kill", "stop", "continue", "fill", "empty", "cut", "mend"]

# Seconds that a fault lasts. A stop of 3 s is as long as Zenoh's lease: links break and come back.
LENGTHS_S: dict[Kind, tuple[float, float]] = {
    "kill": (0.0, 0.0),
    "stop": (0.1, 3.0),
    "slow": (1.0, 5.0),
    "fill": (1.0, 5.0),
    "partition": (1.0, 5.0),
}
PAIRS: dict[Kind, tuple[Deed, Deed]] = {
    "stop": ("stop", "continue"),
    "fill": ("fill", "empty"),
    "partition": ("cut", "mend"),
}
TURN_S = 0.02  # slow: stopped for so long, then running for so long
LINK = "link"  # whom a partition befalls: this host's interface to the others
FILLED = (LEARNER, RECORDER)  # who writes as it goes: their disk can be full

# No fault in the first two seconds, nor at the end, where everybody shall be back: a learner that starts
# again on a busy machine takes 5 s. Of a short run a quarter at most.
BEGIN_S, END_S = 2.0, 10.0
LEAST_S = 8.0  # duration

ItemT = TypeVar("ItemT")


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        at_s: when, in seconds of run time.
        process: whom it befalls, by name.
        kind: "kill": SIGKILL. "stop": SIGSTOP, then SIGCONT. "slow": both by turns, so it runs half of the
            time. "fill": no file of its can grow, as if its disk were full. "partition": the network
            interface is down.
        for_s: seconds that it lasts; 0 for a kill.
    """

    at_s: float
    process: str
    kind: Kind
    for_s: float = 0.0

    @property
    def deeds(self) -> tuple[tuple[float, Deed], ...]:
        """What is done to the process, each so many seconds after the fault begins."""
        if self.kind == "kill":
            return ((0.0, "kill"),)
        if self.kind != "slow":
            begin, end = PAIRS[self.kind]
            return ((0.0, begin), (self.for_s, end))
        turns = max(1, round(self.for_s / (2 * TURN_S)))
        found: list[tuple[float, Deed]] = []
        for turn in range(turns):
            found += [(2 * turn * TURN_S, "stop"), ((2 * turn + 1) * TURN_S, "continue")]
        return tuple(found)


def plan(
    seed: int,
    kills: int,
    duration_s: float,
    kinds: Sequence[Kind],
    processes: Sequence[str] = PROCESSES,
) -> tuple[Fault, ...]:
    """Faults in order of time, each at a random instant, on a random process, for a random time.

    Processes and kinds are dealt like cards, so that short plans have some of each.

    Args:
        seed: of all that is random.
        kills: how many faults, of all kinds.
        duration_s: of the run.
        kinds: to choose from.
        processes: likewise, by name.

    Raises:
        ConfigError: there is nothing to choose from, or no time for it.
    """
    if kills < 1:
        raise ConfigError("kills", kills, "must be at least 1")
    if not duration_s >= LEAST_S:
        raise ConfigError("duration_s", duration_s, f"must be at least {LEAST_S:g} for faults to fit in")
    if not kinds or set(kinds) - set(KINDS):
        raise ConfigError("kinds", ",".join(kinds), f"some of {','.join(KINDS)}")
    rng = random.Random(seed)
    first_s, last_s = min(BEGIN_S, duration_s / 4), duration_s - min(END_S, duration_s / 4)
    instants = sorted(rng.uniform(first_s, last_s) for _ in range(kills))
    victims, chosen = _dealt(rng, processes), _dealt(rng, kinds)
    fillable = _dealt(rng, FILLED)
    faults = []
    for at_s in instants:
        kind, process = next(chosen), next(victims)
        if kind == "fill" and process not in FILLED:
            process = next(fillable)
        process = LINK if kind == "partition" else process
        faults.append(Fault(round(at_s, 3), process, kind, round(rng.uniform(*LENGTHS_S[kind]), 3)))
    return tuple(faults)


def parse_kinds(text: str) -> tuple[Kind, ...]:
    """`kill,stop` as kinds, each once.

    Raises:
        ConfigError: one is none.
    """
    words = [word.strip() for word in text.split(",") if word.strip()]
    found = tuple(kind for kind in KINDS if kind in words)
    if not words or set(words) - set(KINDS):
        raise ConfigError("kinds", text, f"some of {','.join(KINDS)}, with commas in between")
    return found


def _dealt(rng: random.Random, items: Sequence[ItemT]) -> Iterator[ItemT]:
    """All items in a random order, then all again in another, without end."""
    while True:
        yield from rng.sample(list(items), len(items))
