"""What the env server counts and measures of each tick."""

from __future__ import annotations

from dataclasses import dataclass

from env_server.rollout import Turn
from rtcore.ledger import Ledger
from rtcore.messages import CAUSES, EpisodeReturn, MissCause
from rtcore.pacer import Pacer, Tick

COUNTERS = (
    "ticks", "resets", "produced", "episodes", "missed", *(f"missed.{cause}" for cause in CAUSES),
    "overruns", "skipped", "down", "lives", "action.stale", "action.invalid", "action.clipped",
    "world.broken", "log.dropped", "log.errors",
)  # fmt: skip
OVERRUN_EVENT_NS = 1_000_000_000  # at most one line per second about overruns


@dataclass(frozen=True, slots=True)
class Latency:
    """How the newest action fared on its way, in ns; -1: there was none, or it answers no recent tick.

    Attributes:
        loop_ns: step sent -> its answer received here.
        reaction_ns: the agent's own share: observation received -> action sent.
    """

    loop_ns: int = -1
    reaction_ns: int = -1


class Accounts:
    """Keeps the ledger of the loop, which is the one thread that calls `tick`."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._pacing = ledger.histogram("pacing")
        self._loop = ledger.histogram("loop")
        self._absent = False
        self._lost_since = 0
        self._next_overrun_event_ns = 0
        for name in COUNTERS:
            ledger.count(name, 0)  # a counter that stays 0 is reported as well

    def begin(self, down: int) -> None:
        """Enter the beginning of this life, with the deadlines that passed while no env server lived."""
        self._ledger.count("lives")
        self._ledger.count("down", down)

    def executed(self, turn: Turn) -> None:
        """Enter an executed tick before anybody can learn from it: then no kill leaves more learned than
        produced."""
        self._ledger.count_together("ticks", "resets" if turn.decision is None else "produced")

    def tick(self, tick: Tick, turn: Turn, latency: Latency, *, absent: bool = False) -> None:
        """Enter what an executed tick was like; `absent`: there is no agent to answer it."""
        count = self._ledger.count
        self._pacing.record(max(0, tick.woke_ns - tick.due_ns))
        if latency.loop_ns >= 0:
            self._loop.record(latency.loop_ns)
        if turn.verdict in ("stale", "invalid"):
            count(f"action.{turn.verdict}")
        if tick.skipped:
            self._overrun(tick)
        if turn.decision is not None:
            if turn.decision.clipped:
                count("action.clipped")
            self._presence(tick, absent=absent and turn.decision.missed)
        if turn.broken:
            count("world.broken")
            self._ledger.event(tick.woke_ns, "ERROR", f"tick {tick.index}: the world gave NaN or Inf; reset")
        if turn.episode_return is not None:
            self._episode(tick, turn, turn.episode_return)

    def superseded(self, latency: Latency) -> None:
        """Enter a message that had a newer one right behind it."""
        self._ledger.count("action.stale")
        if latency.loop_ns >= 0:
            self._loop.record(latency.loop_ns)

    def miss(self, cause: MissCause) -> None:
        """Enter a missed deadline. Only now, with its cause, so that the causes always add up."""
        self._ledger.count_together("missed", f"missed.{cause}")

    def close(self, pacer: Pacer) -> None:
        """Enter the deadlines that were lost after the last executed tick."""
        lost = pacer.skipped_total - self._ledger.counter("skipped")
        if lost > 0:
            self._ledger.count("overruns")
            self._ledger.count("skipped", lost)

    def _overrun(self, tick: Tick) -> None:
        self._ledger.count("overruns")
        self._ledger.count("skipped", tick.skipped)
        self._lost_since += tick.skipped
        if tick.woke_ns >= self._next_overrun_event_ns:
            self._ledger.event(tick.woke_ns, "WARN", f"tick {tick.index}: {self._lost_since} deadlines lost")
            self._lost_since = 0
            self._next_overrun_event_ns = tick.woke_ns + OVERRUN_EVENT_NS

    def _presence(self, tick: Tick, *, absent: bool) -> None:
        if absent != self._absent:
            self._absent = absent
            if absent:
                self._ledger.event(tick.woke_ns, "WARN", f"tick {tick.index}: the agent is absent")
            else:
                self._ledger.event(tick.woke_ns, "INFO", f"tick {tick.index}: the agent answers")

    def _episode(self, tick: Tick, turn: Turn, value: float) -> None:
        self._ledger.count("episodes")
        episode = EpisodeReturn(
            episode=turn.episode, at_ns=tick.due_ns, value=value, length=turn.episode_tick
        )
        self._ledger.episode(episode)
