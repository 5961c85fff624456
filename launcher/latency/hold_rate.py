"""The highest rate whose miss ratio stays below a limit: a search over a ladder of rates, and what it proves.

A miss ratio of 1e-4 cannot be seen in a short run: without any miss, 30 000 ticks are needed to say with
95 % confidence that it is below. So short runs find where to look, and one long run decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

LIMIT = 1e-4
CONFIDENCE = 0.95
LADDER_HZ = (100, 200, 250, 400, 500, 800, 1000, 1250, 1600, 2000, 2500, 3200, 4000)
SCREENING_S = 5.0
SCREENING_TICKS = 1000  # at least, at low rates

Stage = Literal["screening", "confirmation"]


@dataclass(frozen=True)
class Counted:
    """Deadlines judged in one run, and how many of them were missed or lost to an overrun."""

    ticks: int
    missed: int


@dataclass(frozen=True)
class Attempt:
    """One run of the search.

    Attributes:
        hz: its rate.
        stage: a screening is passed unless it refutes the limit; a confirmation, only if it proves it.
        counted: what was seen.
        at_least, at_most: one-sided bounds of the miss ratio, each with the search's confidence.
        passed: whether the search went on from here upwards.
    """

    hz: float
    stage: Stage
    counted: Counted
    at_least: float
    at_most: float
    passed: bool


@dataclass
class Search:
    """How far a search came.

    Attributes:
        limit, confidence: what is to be shown.
        attempts: every run, in order.
        established_hz: the highest rate that is shown to keep the limit; None as long as there is none.
        ended: False if it was interrupted.
    """

    limit: float = LIMIT
    confidence: float = CONFIDENCE
    attempts: list[Attempt] = field(default_factory=list)
    established_hz: float | None = None
    ended: bool = False


Measure = Callable[[float, float], Counted]  # (hz, seconds) -> what was seen


def ticks_needed(limit: float = LIMIT, confidence: float = CONFIDENCE) -> int:
    """How many ticks without a miss show a miss ratio below `limit`: (1 - limit)^n <= 1 - confidence."""
    return math.ceil(math.log(1 - confidence) / math.log1p(-limit))


def upper_bound(counted: Counted, confidence: float = CONFIDENCE) -> float:
    """The largest miss ratio under which so few misses have a probability of 1 - confidence (Clopper and
    Pearson 1934, one-sided): exact if misses are independent. They come in bursts, which makes it too small.
    """
    if counted.missed >= counted.ticks:
        return 1.0
    return _root(lambda p: _at_most(counted.missed, counted.ticks, p), 1 - confidence)


def lower_bound(counted: Counted, confidence: float = CONFIDENCE) -> float:
    """The smallest miss ratio under which so many misses have a probability of 1 - confidence; see above."""
    if counted.missed == 0:
        return 0.0
    return _root(lambda p: _at_most(counted.missed - 1, counted.ticks, p), confidence)


def search(measure: Measure, ladder: Sequence[float], progress: Search) -> None:
    """Find the highest rate of `ladder` that keeps `progress.limit`; `progress` holds what was found so far.

    Screening goes up the ladder in strides that double, until a rate is refuted, and then bisects. The
    highest rate that passed is confirmed; if that fails, the next lower one, until one is proved or none
    is left.

    Args:
        measure: runs the system at a rate for some seconds.
        ladder: rates in Hz, rising.
        progress: filled while it goes on, so that an interruption loses nothing.
    """
    needed = ticks_needed(progress.limit, progress.confidence)
    highest = _screen(measure, ladder, progress, needed)
    for hz in reversed(ladder[: highest + 1]):
        if _try(measure, hz, needed / hz, "confirmation", progress):
            progress.established_hz = hz
            break
    progress.ended = True


def statement(search: Search) -> list[str]:
    """What was established, in sentences."""
    limit, percent = f"{search.limit:g}", f"{100 * search.confidence:g} %"
    lines = []
    held = search.established_hz
    if held is None:
        lines.append(f"No rate is shown to keep the miss ratio below {limit}.")
    else:
        proof = next(a for a in search.attempts if a.hz == held and a.stage == "confirmation" and a.passed)
        seen = f"{proof.counted.missed} of {proof.counted.ticks:,} deadlines were missed"
        lines.append(
            f"{held:g} Hz is held: {seen}, so the miss ratio is below {limit} with {percent} confidence"
            f" (at most {proof.at_most:.2g})."
        )
    for attempt in sorted(search.attempts, key=lambda one: one.hz):
        if not attempt.passed and (held is None or attempt.hz > held):
            seen = (
                f"{attempt.counted.missed} of {attempt.counted.ticks:,} deadlines missed in {attempt.stage}"
            )
            verdict = (
                f"at least {attempt.at_least:.2g}"
                if attempt.at_least > search.limit
                else "neither shown nor refuted"
            )
            lines.append(f"{attempt.hz:g} Hz is not: {seen} ({verdict}).")
    lines.append(
        "The first second of each run is left out. The bounds take misses for independent; they come in"
        " bursts, so a longer run may say otherwise."
    )
    if not search.ended:
        lines.insert(0, "The search was interrupted.")
    return lines


def _screen(measure: Measure, ladder: Sequence[float], progress: Search, needed: int) -> int:
    """The index of the highest rate found that a short run does not refute; -1 if there is none."""
    passed, refuted, stride = -1, len(ladder), 1
    while refuted - passed > 1:
        doubling = refuted == len(ladder)
        index = min(passed + (stride if doubling else (refuted - passed) // 2), refuted - 1)
        hz = ladder[index]
        seconds = min(max(SCREENING_S, SCREENING_TICKS / hz), needed / hz)
        if _try(measure, hz, seconds, "screening", progress):
            passed, stride = index, 2 * stride
        else:
            refuted = index
    return passed


def _try(measure: Measure, hz: float, seconds: float, stage: Stage, progress: Search) -> bool:
    counted = measure(hz, seconds)
    at_least = lower_bound(counted, progress.confidence)
    at_most = upper_bound(counted, progress.confidence)
    passed = at_least <= progress.limit if stage == "screening" else at_most <= progress.limit
    progress.attempts.append(Attempt(hz, stage, counted, at_least, at_most, passed))
    return passed


def _at_most(k: int, n: int, p: float) -> float:
    """P(X <= k) for X ~ Binomial(n, p), summed in logarithms."""
    if p <= 0.0:
        return 1.0
    if p >= 1.0:
        return 1.0 if k >= n else 0.0
    log_p, log_q = math.log(p), math.log1p(-p)
    log_terms = [
        math.lgamma(n + 1) - math.lgamma(i + 1) - math.lgamma(n - i + 1) + i * log_p + (n - i) * log_q
        for i in range(k + 1)
    ]
    largest = max(log_terms)
    return math.exp(largest) * math.fsum(math.exp(term - largest) for term in log_terms)


def _root(falling: Callable[[float], float], target: float) -> float:
    """Where a falling function on [0, 1] crosses `target`, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if falling(middle) > target else (low, middle)
    return high
