"""How much of the machine the learner uses: what its governor and its configuration say, carried out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from learner.governor import Governor, Power
from rtcore.config import LearnerConfig
from rtcore.ledger import Ledger
from rtcore.messages import Phase, Step


@dataclass(frozen=True)
class Levers:
    """What the governor moves.

    Attributes:
        cores: that the process may use, as it starts.
        set_threads: of the arithmetic. Lowered, it does free a core: the idle OpenMP worker stops spinning
            within milliseconds (0.00 s of CPU time in the next 2 s); the call costs 0.2 us.
        set_cores: of the whole process; may raise OSError.
    """

    cores: tuple[int, ...]
    set_threads: Callable[[int], None]
    set_cores: Callable[[Sequence[int]], None]

    def cores_for(self, threads: int) -> tuple[int, ...]:
        """The cores of a learner of so many threads: the first one, the tick's, only if it needs them all.

        Misses at 500 Hz on two cores with nothing pinned, beside a learner of one thread: 9.8 % where it
        was free to move, 1.6 % where it kept to the second core, 1.6 % without it (two runs of 7 s each).
        """
        return self.cores if threads >= len(self.cores) else self.cores[1:]


class PowerControl:
    """Sets the learner's threads and cores, and the pause after each piece of work.

    Counts `governor.decisions`, `governor.ticks` (those that came in the logs) and `governor.limited_ticks`
    (with less than full power). The gauges are `governor/threads`, `governor/duty` and `governor/load`:
    the share of its period that the loop took, 99th percentile of the last seconds, of a fleet's worst loop.
    """

    def __init__(self, config: LearnerConfig, levers: Levers | None, ledger: Ledger) -> None:
        """Without `levers`, as in virtual time, nothing governs."""
        self._config = config
        self._levers = levers
        self._ledger = ledger
        self._governor: Governor | None = None
        self._pause_ends_ns = 0

    def meet(self, tick_ns: int, envs: Collection[str], now_ns: int) -> None:
        """The environments and their control period are known: begin to govern, if that is wanted."""
        if self._levers is None or self._config.governor == "off":
            return
        threads = min(self._config.threads, len(self._levers.cores))  # more would wait for each other
        self._governor = Governor(threads, tick_ns, envs)
        power = self._governor.power
        cores = ", ".join(map(str, self._levers.cores_for(power.threads)))
        self._ledger.event(now_ns, "INFO", f"governor: begins with {power.describe(threads)}, core {cores}")
        self._use(power, now_ns)

    def watch(self, steps: Sequence[Step], now_ns: int) -> None:
        """Take the next steps of the logs, and do what follows from them."""
        if self._governor is None or not steps:
            return
        self._ledger.count("governor.ticks", len(steps))
        if self._governor.limited:
            self._ledger.count("governor.limited_ticks", len(steps))
        decision = self._governor.feed(steps, now_ns)
        if decision is not None:
            self._ledger.count("governor.decisions")
            self._ledger.event(now_ns, "INFO", f"governor: {decision.text}")
            self._use(decision.power, now_ns)

    def worked(self, begin_ns: int, end_ns: int, phase: Phase) -> None:
        """The learner computed from `begin_ns` to `end_ns`, and pauses as long as its share asks for."""
        share = 0.5 if phase == "hold" and self._config.hold_learning == "half" else 1.0
        if self._governor is not None:
            self._governor.worked(begin_ns, end_ns)
            share *= self._governor.power.duty
        self._pause_ends_ns = end_ns + round((end_ns - begin_ns) * (1.0 / share - 1.0))

    def pause_s(self, now_ns: int) -> float:
        """What is left of the pause, in seconds; 0 when there is none."""
        return max(0, self._pause_ends_ns - now_ns) / 1e9

    def report(self) -> None:
        """Set the gauges."""
        if self._governor is not None:
            self._ledger.gauge("governor/threads", self._governor.power.threads)
            self._ledger.gauge("governor/duty", self._governor.power.duty)
            self._ledger.gauge("governor/load", self._governor.load)

    def _use(self, power: Power, now_ns: int) -> None:
        assert self._levers is not None
        self._levers.set_threads(power.threads)
        try:
            self._levers.set_cores(self._levers.cores_for(power.threads))
        except (OSError, AttributeError) as error:  # AttributeError: this system's Python has no such call
            self._ledger.event(now_ns, "WARN", f"governor: the learner keeps its cores: {error}")
