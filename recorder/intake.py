"""What the recorder hears: the env servers' logs, everybody's stats, the learner's phases and policies."""

from __future__ import annotations

from collections.abc import Sequence

from recorder.place import Place
from recorder.telemetry import TelemetryRows
from rtcore import channels
from rtcore.bus import Bus
from rtcore.cast import role_of
from rtcore.log_reader import LogReader
from rtcore.messages import Spec, Stats, Step

# Batches of each log, 20 a second: all of its env server's cache, 2000, which comes at once after a restart,
# and 25 s more of them. At 1 kHz 63 MB, and 0.4 s to read (measured).
LOG_CAPACITY = 2_500
STATS_CAPACITY = 2_000
POLICY_CAPACITY = 64  # a few hundred kB each
WINDOW_CAPACITY = 2_000
# Whose last words are waited for. The launcher's come after the recorder's end.
WAITED_FOR = tuple(role for role in channels.PROCESSES if role != channels.RECORDER)


class Intake:
    """Drains the bus into steps and telemetry, and counts what got lost on the way.

    Args:
        bus: to hear.
        envs: names of the environments.
        telemetry: takes all that is no step.
    """

    def __init__(self, bus: Bus, envs: Sequence[str], telemetry: TelemetryRows) -> None:
        self._known: set[str] = set()  # environments that declared themselves
        self._specs = {env: bus.latest(channels.SPEC, env) for env in envs}
        self._logs = {env: LogReader(bus, env, capacity_batches=LOG_CAPACITY) for env in envs}
        self._stats = bus.queue(channels.STATS, "*", capacity=STATS_CAPACITY)
        self._notices = bus.queue(channels.WINDOW, capacity=WINDOW_CAPACITY)
        self._policies = bus.queue(channels.POLICY, capacity=POLICY_CAPACITY)
        self._telemetry = telemetry
        self._speaking: set[str] = set()  # processes heard whose final stats are still to come
        self.placements: dict[str, str] = {}  # process -> what the system granted it

    def go_on_from(self, place: Place) -> None:
        """Begin where an earlier life of the recorder ended. Call it before anything is taken."""
        for env, own in place.envs.items():
            if env in self._logs:
                self._logs[env].go_on_from(own.log)
        self.placements = dict(place.placements)

    @property
    def positions(self) -> dict[str, tuple[int, int] | None]:
        """By environment, (incarnation, seq) of the step that is due next; None before the first step."""
        return {env: log.stream.position for env, log in self._logs.items()}

    @property
    def gaps(self) -> dict[str, int]:
        """By environment, steps that never came. A batch lost to a full queue shows here, by its steps."""
        return {env: log.stream.gaps for env, log in self._logs.items()}

    @property
    def dropped(self) -> int:
        """Steps that never came, and other messages lost to a full queue."""
        others = self._stats.dropped + self._notices.dropped + self._policies.dropped
        return sum(self.gaps.values()) + others

    @property
    def complete(self) -> bool:
        """All env servers have ended in order, and everybody heard has sent final stats."""
        return all(log.ended for log in self._logs.values()) and not self._speaking

    def wait(self, timeout_s: float) -> None:
        """Wait for steps of an env server that has not ended, at most so long."""
        logs = list(self._logs.values())
        next((log for log in logs if not log.ended), logs[0]).wait(timeout_s)

    def take_specs(self) -> dict[str, Spec]:
        """The env servers' declarations that are new, by environment."""
        taken = {env: reader.take() for env, reader in self._specs.items()}
        found = {env: received.message for env, received in taken.items() if received is not None}
        for env in found.keys() - self._known:  # the log is of the world that is written of
            self._known.add(env)
            self._logs[env].expect(found[env])
        return found

    def take_steps(self, env: str, now_ns: int) -> list[Step]:
        """An environment's new steps in order, each once; those behind a missing one come when it does, or
        5 s later."""
        return self._logs[env].read(now_ns)

    def give_up_on_gaps(self) -> dict[str, list[Step]]:
        """The steps that still waited for earlier ones; those now count as lost."""
        return {env: log.finish() for env, log in self._logs.items()}

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
        elif role_of(stats.process) in WAITED_FOR:
            self._speaking.add(stats.process)
        prefix = f"{stats.process}: "  # every process's first event: its scheduling and cores
        for event in stats.events:
            if event.text.startswith(prefix):
                self.placements[stats.process] = event.text.removeprefix(prefix)
