"""What the recorder hears: the env server's log, everybody's stats, the learner's phases and policies."""

from __future__ import annotations

from recorder.place import Place
from recorder.telemetry import TelemetryRows
from rtcore import channels
from rtcore.bus import Bus
from rtcore.log_reader import LogReader
from rtcore.messages import Spec, Stats, Step

LOG_CAPACITY = 2_000  # batches: 100 s of a recorder that hangs, 50 MB at 1 kHz
STATS_CAPACITY = 2_000
POLICY_CAPACITY = 64  # a few hundred kB each
WINDOW_CAPACITY = 2_000
# Whose last words are waited for. The launcher's come after the recorder's end.
WAITED_FOR = tuple(name for name in channels.PROCESSES if name != channels.RECORDER)


class Intake:
    """Drains the bus into steps and telemetry, and counts what got lost on the way."""

    def __init__(self, bus: Bus, env: str, telemetry: TelemetryRows) -> None:
        self._specs = bus.latest(channels.SPEC, env)
        self._log = LogReader(bus, env, capacity_batches=LOG_CAPACITY)
        self._stats = bus.queue(channels.STATS, "*", capacity=STATS_CAPACITY)
        self._notices = bus.queue(channels.WINDOW, capacity=WINDOW_CAPACITY)
        self._policies = bus.queue(channels.POLICY, capacity=POLICY_CAPACITY)
        self._telemetry = telemetry
        self._speaking: set[str] = set()  # processes heard whose final stats are still to come
        self.placements: dict[str, str] = {}  # process -> what the system granted it

    def go_on_from(self, place: Place) -> None:
        """Begin where an earlier life of the recorder ended. Call it before anything is taken."""
        self._log.go_on_from(place.log)
        self.placements = dict(place.placements)

    @property
    def position(self) -> tuple[int, int] | None:
        """(incarnation, seq) of the step that is due next; None before the first step."""
        return self._log.stream.position

    @property
    def gaps(self) -> int:
        """Steps that never came. A batch lost to a full queue shows here, by its steps."""
        return self._log.stream.gaps

    @property
    def dropped(self) -> int:
        """Steps that never came, and other messages lost to a full queue."""
        others = self._stats.dropped + self._notices.dropped + self._policies.dropped
        return self.gaps + others

    @property
    def complete(self) -> bool:
        """The env server has ended in order, and everybody heard has sent final stats."""
        return self._log.ended and not self._speaking

    def wait(self, timeout_s: float) -> None:
        """Wait for steps, at most so long."""
        self._log.wait(timeout_s)

    def take_spec(self) -> Spec | None:
        """The env server's declaration, if it is new."""
        received = self._specs.take()
        return received.message if received is not None else None

    def take_steps(self, now_ns: int) -> list[Step]:
        """New steps in order, each once; those behind a missing one come when it does, or 5 s later."""
        return self._log.read(now_ns)

    def give_up_on_gaps(self) -> list[Step]:
        """The steps that still waited for earlier ones; those now count as lost."""
        return self._log.finish()

    def take_telemetry(self) -> int:
        """Pass on stats, phases and policies; returns how many messages there were."""
        notices, policies, stats = self._notices.drain(), self._policies.drain(), self._stats.drain()
        for notice in notices:
            self._telemetry.window(notice.message)
        for policy in policies:
            self._telemetry.policy(policy.message)
        for message in stats:
            self._take_stats(message.message)
        return len(notices) + len(policies) + len(stats)

    def _take_stats(self, stats: Stats) -> None:
        self._telemetry.stats(stats)
        if stats.final:
            self._speaking.discard(stats.process)
        elif stats.process in WAITED_FOR:
            self._speaking.add(stats.process)
        prefix = f"{stats.process}: "  # every process's first event: its scheduling and cores
        for event in stats.events:
            if event.text.startswith(prefix):
                self.placements[stats.process] = event.text.removeprefix(prefix)
