"""`tenuto sim`: the same services in one process, in virtual time over the in-memory bus.

Work takes no time here: an action is there at its deadline, the learner makes all the gradient steps
that its update-to-data limit allows. A fleet's environments take turns in the order of their deadlines. The
same seed gives bit-equal weights and the same summary.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import NamedTuple

from agent_service.service import AgentService
from env_server.announcing import Past
from env_server.service import EnvService
from env_server.worlds.registry import make_world
from launcher.summary import StatsByProcess
from learner.algorithm import prepare
from learner.service import LearnerService
from recorder.service import RecorderService
from rtcore import cast
from rtcore.bus import Bus
from rtcore.cast import Part
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, RECORDER
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Stats
from rtcore.pacer import Tick
from rtcore.process import REPORT_PERIOD_S, Reporter
from rtcore.run_dir import RunDir

START_NS = 1_000_000_000  # the virtual clock's first instant; any will do


class Pair(NamedTuple):
    """An environment and who acts in it."""

    env: EnvService
    agent: AgentService


class Simulation:
    """All services on one virtual clock, turned tick by tick."""

    def __init__(self, config: RunConfig, run_dir: RunDir, stack: ExitStack) -> None:
        """`stack` closes what is opened here, in reverse order."""
        self._config = config
        prepare(config.learner)
        self._clock = VirtualClock(START_NS)
        self._hub = MemoryHub()
        self._buses: dict[str, Bus] = {}
        self.ledgers = {name: Ledger(name, START_NS) for name in cast.names(config)}
        clock, ledgers = self._clock, self.ledgers
        envs = [self._env(part, run_dir, stack) for part in cast.parts(config) if part.role == ENV_SERVER]
        agents = [self._agent(part, stack) for part in cast.parts(config) if part.role == AGENT]
        self.pairs = [Pair(env, agent) for env, agent in zip(envs, agents, strict=True)]
        self.learner = LearnerService(config, run_dir, self._bus(LEARNER, stack), clock, ledgers[LEARNER])
        self.recorder: RecorderService | None = None
        if config.recorder.record:
            self.recorder = RecorderService(
                config, run_dir, self._bus(RECORDER, stack), clock, ledgers[RECORDER]
            )
        self._reporters = {
            name: Reporter(ledger, self._buses[name], clock, name)
            for name, ledger in ledgers.items()
            if name in self._buses
        }
        self._report_due_ns = START_NS

    def run(self, stop: Stop, progress: Callable[[float], None]) -> None:
        """Run to the end of the configured duration; `progress` hears the run time in seconds."""
        for pair in self.pairs:
            pair.env.announce()
            pair.agent.attend()
        hz = self._config.env.hz or 1.0
        for pair, tick in self._turns(stop):
            pair.agent.poll_policies()
            pair.env.step(tick)  # the agent answers within it
            pair.agent.check()
            flushed = pair.env.journal.flush_due(self._clock.now_ns())
            self.learner.catch_up()  # every tick: publications are due between flushes too
            if flushed:
                self._record()
                progress(tick.index / hz)
        for pair in self.pairs:
            pair.env.close()
        self.learner.catch_up()
        self.learner.close()
        for pair in self.pairs:
            pair.agent.poll_policies()
            pair.agent.close()

    def finish(self) -> StatsByProcess:
        """End the recording; returns everybody's last ledger, as the processes would have sent it."""
        found = {name: [self._last_words(name)] for name in self._reporters if name != RECORDER}
        if self.recorder is not None:
            self.recorder.close()
            found[RECORDER] = [self._last_words(RECORDER)]
        return found

    def _turns(self, stop: Stop) -> Iterator[tuple[Pair, Tick]]:
        """Everybody's ticks, in the order of time: number k of one environment after the other. The stop ends
        the first one's; the others get as far as that one did."""
        first, *others = self.pairs
        following = [(pair, pair.env.pacer.ticks(Stop())) for pair in others]
        for tick in first.env.pacer.ticks(stop):
            yield first, tick
            for pair, ticks in following:
                yield pair, next(ticks)

    def _env(self, part: Part, run_dir: RunDir, stack: ExitStack) -> EnvService:
        config = cast.as_part(self._config, part)
        world = make_world(config.env, config.seed)
        stack.callback(world.close)
        if not part.number:  # all are alike
            world.save_scene(run_dir.world_path)
        bus, ledger = self._bus(part.name, stack), self.ledgers[part.name]
        return EnvService(config, world, bus, self._clock, ledger, START_NS, past=Past(part=part))

    def _agent(self, part: Part, stack: ExitStack) -> AgentService:
        config = cast.as_part(self._config, part)
        bus, ledger = self._bus(part.name, stack), self.ledgers[part.name]
        return AgentService(config, bus, self._clock, ledger, number=part.number)

    def _last_words(self, name: str) -> Stats:
        last = self._reporters[name].snapshot(final=True)
        self._reporters[name].publish(last)
        return last

    def _record(self) -> None:
        """Let everybody report when it is time, and the recorder take it in."""
        if self.recorder is None:
            return
        if self._clock.now_ns() >= self._report_due_ns:
            self._report_due_ns = self._clock.now_ns() + round(REPORT_PERIOD_S * 1e9)
            for reporter in self._reporters.values():
                reporter.publish(reporter.snapshot())
        self.recorder.poll()

    def _bus(self, name: str, stack: ExitStack) -> Bus:
        bus = self._buses[name] = self._hub.bus(name, self._clock)
        stack.callback(bus.close)
        return bus


def simulate(
    config: RunConfig, run_dir: RunDir, stop: Stop, progress: Callable[[float], None]
) -> tuple[StatsByProcess, float]:
    """Run a simulation; returns everybody's stats and the wall time it took, in seconds."""
    begin = time.monotonic()
    with ExitStack() as stack:
        simulation = Simulation(config, run_dir, stack)
        simulation.run(stop, progress)
        stats = simulation.finish()
    return stats, time.monotonic() - begin
