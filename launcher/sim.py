"""`tenuto sim`: the same services in one process, in virtual time over the in-memory bus.

Work takes no time here: an action is there at its deadline, the learner makes all the gradient steps
that its update-to-data limit allows. The same seed gives bit-equal weights and the same summary.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack

from agent_service.service import AgentService
from env_server.service import EnvService
from env_server.worlds.registry import make_world
from launcher.summary import StatsByProcess
from learner.algorithm import prepare
from learner.service import LearnerService
from recorder.service import RecorderService
from rtcore import channels
from rtcore.bus import Bus
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Stats
from rtcore.process import REPORT_PERIOD_S, Reporter
from rtcore.run_dir import RunDir

START_NS = 1_000_000_000  # the virtual clock's first instant; any will do


class Simulation:
    """All services on one virtual clock, turned tick by tick."""

    def __init__(self, config: RunConfig, run_dir: RunDir, stack: ExitStack) -> None:
        """`stack` closes what is opened here, in reverse order."""
        self._config = config
        prepare(config.learner)
        self._clock = VirtualClock(START_NS)
        self._hub = MemoryHub()
        self._buses: dict[str, Bus] = {}
        self.ledgers = {name: Ledger(name, START_NS) for name in channels.PROCESSES}
        clock, ledgers = self._clock, self.ledgers
        world = make_world(config.env, config.seed)
        stack.callback(world.close)
        world.save_scene(run_dir.world_path)
        self.env = EnvService(
            config,
            world,
            self._bus(channels.ENV_SERVER, stack),
            clock,
            ledgers[channels.ENV_SERVER],
            START_NS,
        )
        self.agent = AgentService(config, self._bus(channels.AGENT, stack), clock, ledgers[channels.AGENT])
        self.learner = LearnerService(
            config, run_dir, self._bus(channels.LEARNER, stack), clock, ledgers[channels.LEARNER]
        )
        self.recorder: RecorderService | None = None
        if config.recorder.record:
            self.recorder = RecorderService(
                config, run_dir, self._bus(channels.RECORDER, stack), clock, ledgers[channels.RECORDER]
            )
        self._reporters = {
            name: Reporter(ledger, self._buses[name], clock, name)
            for name, ledger in ledgers.items()
            if name in self._buses
        }
        self._report_due_ns = START_NS

    def run(self, stop: Stop, progress: Callable[[float], None]) -> None:
        """Run to the end of the configured duration; `progress` hears the run time in seconds."""
        self.env.announce()
        self.agent.attend()
        hz = self._config.env.hz or 1.0
        for tick in self.env.pacer.ticks(stop):
            self.agent.poll_policies()
            self.env.step(tick)  # the agent answers within it
            self.agent.check()
            flushed = self.env.journal.flush_due(self._clock.now_ns())
            self.learner.catch_up()  # every tick: publications are due between flushes too
            if flushed:
                self._record()
                progress(tick.index / hz)
        self.env.close()
        self.learner.catch_up()
        self.learner.close()
        self.agent.poll_policies()
        self.agent.close()

    def finish(self) -> StatsByProcess:
        """End the recording; returns everybody's last ledger, as the processes would have sent it."""
        found = {name: [self._last_words(name)] for name in self._reporters if name != channels.RECORDER}
        if self.recorder is not None:
            self.recorder.close()
            found[channels.RECORDER] = [self._last_words(channels.RECORDER)]
        return found

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
