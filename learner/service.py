"""The learner's loop: take what the world did, improve, forecast and publish when it is time.

One thread trains; messages arrive on the bus's threads and leave through the outbox's. `step` is one
turn of the loop and never waits; `run` repeats it in a process, `catch_up` in virtual time.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable
from typing import assert_never

from learner import resume
from learner.algorithm import Algorithm, make_algorithm
from learner.budget import TableBudget, UpdateBudget
from learner.conductor import (
    Conductor,
    Happening,
    PhaseEntered,
    PublishDue,
    PublishMissed,
    UnitEnded,
    WindowEntered,
)
from learner.intake import Intake
from learner.orders import Orders
from learner.outbox import Outbox
from learner.power import Levers, PowerControl
from learner.publication import Publication
from learner.replay import open_replay
from learner.schedule.scheduler import Scheduler
from rtcore import channels
from rtcore.bus import Bus
from rtcore.clock import Clock
from rtcore.config import TABULAR, RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Command, CommandReply, Phase, Spec, WindowNotice
from rtcore.run_dir import RunDir
from rtcore.signing import Signer
from rtcore.spaces import Spaces

IDLE_WAIT_S = 0.02  # nothing to learn from: wait so long for the next batch (they come every 50 ms)
DRAIN_LIMIT_S = 2.0  # after the stop: wait so long for the env server's last batch
LEAD_FLOOR_NS = 50_000_000  # publish at least so long before the unit ends, or a quarter of a shorter unit
METRICS_PERIOD_NS = 250_000_000
COUNTED = ("gradient_steps", "policy_steps", "unread")  # of the algorithm, into the ledger
LEARNER_STREAM = 2  # keeps the learner's random numbers apart from the world's and the agent's


class LearnerService:
    """Trains on the log of one environment."""

    def __init__(
        self,
        config: RunConfig,
        run_dir: RunDir,
        bus: Bus,
        clock: Clock,
        ledger: Ledger,
        *,
        levers: Levers | None = None,
        signer: Signer | None = None,
    ) -> None:
        """`levers`: for the governor; None, as in virtual time: it does not govern."""
        self._config = config
        self._run_dir = run_dir
        self._clock = clock
        self._ledger = ledger
        self._specs = bus.latest(channels.SPEC, config.env.name)
        self.outbox = Outbox(bus, run_dir, clock, ledger, signer)
        self._intake = Intake(bus, config.env.name, ledger, self.outbox.diary)
        kept = run_dir.learner_dir / resume.SCHEDULE_FILE
        self._scheduler = Scheduler(config, clock, ledger, lambda data: self.outbox.keep(kept, data))
        self._conductor = Conductor(self._scheduler.windows)
        self._orders = Orders(self._conductor, self._scheduler, clock, ledger)
        self._budget = (TableBudget if config.learner.algo in TABULAR else UpdateBudget)(config.learner)
        self._power = PowerControl(config.learner, levers, ledger)
        self._notices: list[WindowNotice] = []
        self._publication = Publication(config.learner.algo, self._notices, self.outbox, ledger)
        self._spec: Spec | None = None
        self._on_time = False  # the learner was there before T0: the first window begins on the dot
        self._algorithm: Algorithm | None = None
        self._lead_ns = self._lead_floor_ns = LEAD_FLOOR_NS
        self._metrics_due_ns = 0
        self._progress: deque[tuple[int, int]] = deque(maxlen=5)  # (instant, gradient steps), 4 a second

    def run(self, stop: Stop) -> None:
        """Learn until stopped, then take what the env server still sends."""
        while not stop.is_set():
            self._ledger.beat(self._clock.now_ns())
            if self._spec is None:
                stop.wait(IDLE_WAIT_S)  # the log may be there already, and would not let us wait
                self.step()
            elif not self.step():
                pause_s = self._power.pause_s(self._clock.now_ns())
                self._intake.wait(min(pause_s or IDLE_WAIT_S, IDLE_WAIT_S, self._lead_ns / 2e9))
        deadline = time.monotonic() + DRAIN_LIMIT_S
        while self._spec is not None and not self._intake.ended and time.monotonic() < deadline:
            self._intake.wait(IDLE_WAIT_S)
            self._take_in()

    def catch_up(self) -> None:
        """Do all the work that is there now, as virtual time lets it."""
        while self.step():
            pass
        self.outbox.flush()

    def step(self) -> bool:
        """Take in, keep the schedule, make at most one gradient step. Says whether it made one."""
        begin_ns = self._clock.now_ns()
        self._take_in()
        if self._spec is None or self._algorithm is None:
            return False
        if not self._over(self._spec):
            self._keep_schedule(self._spec)
        elif not self._intake.ended:
            return False  # what still comes is taken in; nothing is learned after the end
        if self._power.pause_s(self._clock.now_ns()) > 0 or not self._budget.allows(self._phase):
            return False
        self._improve(self._algorithm)
        self._power.worked(begin_ns, self._clock.now_ns(), self._phase)
        return True

    def command(self, command: Command) -> CommandReply:
        """Answer an operator; called on the bus's thread."""
        if command.verb == "status":
            return CommandReply(id=command.id, ok=True, text=self._describe())
        return self._orders.take(command)

    def close(self) -> None:
        """Account for what never came, and write the checkpoint."""
        self._intake.finish()
        self._publication.check()
        if self._algorithm is not None:
            self._ledger_metrics(self._algorithm)
            resume.save(self._run_dir, self._algorithm, self._intake)

    # ---- turning the crank

    def _take_in(self) -> None:
        declared = self._specs.take()
        if declared is not None:
            self._meet(declared.message)
        if self._spec is None:
            return
        now_ns = self._clock.now_ns()
        learned, steps = self._intake.take(now_ns)
        if learned:
            self._budget.earn(learned, self._phase)
        self._power.watch(steps, now_ns)

    def _improve(self, algorithm: Algorithm) -> None:
        """One gradient step; of a table, as many as transitions wait."""
        begin_ns = self._clock.now_ns()
        before = {name: getattr(algorithm, name) for name in COUNTED}
        algorithm.update(improve_policy=self._phase == "update")
        done = {name: getattr(algorithm, name) - count for name, count in before.items()}
        self._budget.spend(done["gradient_steps"])
        self._publication.improved |= done["policy_steps"] > 0
        for name, count in done.items():
            self._ledger.count(name, count)
        self._note_duration(self._clock.now_ns() - begin_ns)

    def _meet(self, spec: Spec) -> None:
        if self._spec is not None:
            if spec.incarnation != self._spec.incarnation:
                text = "the env server came back; units and windows go on by its first clock"
                self._ledger.event(self._clock.now_ns(), "WARN", text)
            return
        self._spec = spec
        self._lead_ns = self._lead_floor_ns = min(LEAD_FLOOR_NS, spec.unit_ns // 4)
        learner = self._config.learner
        self._power.meet(spec.tick_ns, self._clock.now_ns())
        directory = self._run_dir.learner_dir / resume.REPLAY_DIR
        replay = open_replay(directory, learner.replay_capacity, spec.observation_dim, spec.action_dim)
        self._intake.meet(spec, replay)
        seed = self._config.seed * 10 + LEARNER_STREAM
        self._algorithm = make_algorithm(self._config, Spaces.of(spec), seed, replay)
        version = resume.last_published(self._run_dir)
        self._publication.go_on_from(version)
        self._scheduler.meet(self._algorithm, resume.timetable(self._run_dir))
        if resume.restore(self._run_dir, self._algorithm, self._intake):
            self._budget.resume(len(replay))
            text = f"goes on from the checkpoint: policy {version}, {len(replay)} transitions in the replay"
            self._ledger.event(self._clock.now_ns(), "INFO", text)

    def _keep_schedule(self, spec: Spec) -> None:
        now_ns = self._clock.now_ns()
        run_ns = now_ns - spec.t0_ns
        if run_ns < 0:
            self._on_time = True
            return
        lead_ns = min(max(self._lead_ns, spec.tick_ns), spec.unit_ns)
        if self._on_time:
            self._on_time = False
            self._handle_all(self._conductor.advance(0, 0), spec)
        self._handle_all(self._conductor.advance(run_ns, lead_ns), spec)
        self._handle_all(self._orders.carry_out(spec.t0_ns), spec)
        if now_ns >= self._metrics_due_ns and self._algorithm is not None:
            self._metrics_due_ns = now_ns + METRICS_PERIOD_NS
            self._ledger_metrics(self._algorithm)
            self._ledger_rate(now_ns)

    def _handle_all(self, happenings: Iterable[Happening], spec: Spec) -> None:
        """Each in its turn: what comes next may follow from it."""
        for happening in happenings:
            self._handle(happening, spec)

    def _handle(self, happening: Happening, spec: Spec) -> None:
        assert self._algorithm is not None
        match happening:
            case UnitEnded(unit):
                self._algorithm.end_unit(unit)
            case WindowEntered(window, unit):
                self._algorithm.begin_window(window, unit)
                self.outbox.diary.window(window, unit, self._algorithm)
                self._scheduler.entered(window)
            case PhaseEntered():
                self._announce(happening, spec)
            case PublishDue():
                self._handle_all(self._orders.carry_out(spec.t0_ns), spec)  # what came before comes first
                self._publish(happening, spec, self._algorithm)
            case PublishMissed(window, iterate):
                if not self._conductor.paused:
                    self._iterate(self._algorithm, iterate)
                self._publication.withhold(window.m, iterate, self._clock.now_ns())
            case _:
                assert_never(happening)

    def _publish(self, due: PublishDue, spec: Spec, algorithm: Algorithm) -> None:
        if self._conductor.improving:
            self._iterate(algorithm, due.iterate)
            self._publication.publish(algorithm, due, spec, self._clock, self._scheduler.windows)
        else:
            self._publication.withhold(due.window.m, due.iterate, self._clock.now_ns())

    def _iterate(self, algorithm: Algorithm, g: int) -> None:
        before = algorithm.policy_steps
        self._publication.improved |= algorithm.iterate(g)
        self._ledger.count("policy_steps", algorithm.policy_steps - before)

    def _announce(self, entered: PhaseEntered, spec: Spec) -> None:
        window = entered.window
        notice = WindowNotice(
            window=window.m,
            start_unit=window.start,
            update_units=window.update,
            hold_units=window.hold,
            phase=entered.phase,
            at_ns=spec.t0_ns + entered.start_ns,
            reason=entered.reason,
        )
        self._notices.append(notice)
        self._ledger.windows(self._notices)
        self._publication.check()
        self.outbox.put(notice)

    # ---- small things

    @property
    def _phase(self) -> Phase:
        """What is being done now, whoever ordered it."""
        return "update" if self._conductor.position is None or self._conductor.improving else "hold"

    def _over(self, spec: Spec) -> bool:
        """Whether the run has ended: no window begins after the world's end."""
        duration_ns = round(self._config.duration_s * 1e9)
        over = 0 < duration_ns <= self._clock.now_ns() - spec.t0_ns
        return over or self._intake.ended

    def _note_duration(self, duration_ns: int) -> None:
        """Keep the publication lead above the time that a step takes (slowly forgotten maximum)."""
        self._lead_ns = max(self._lead_floor_ns, 2 * duration_ns, round(0.99 * self._lead_ns))

    def _ledger_metrics(self, algorithm: Algorithm) -> None:
        for name, value in algorithm.metrics().items():
            self._ledger.gauge(name, value)
        self._ledger.gauge("replay_size", self._intake.replay_size)
        self._power.report()

    def _ledger_rate(self, now_ns: int) -> None:
        """Gradient steps per second over about the last second."""
        done = self._ledger.counter("gradient_steps")
        self._progress.append((now_ns, done))
        begin_ns, begun = self._progress[0]
        if now_ns > begin_ns:
            self._ledger.gauge("updates_per_s", (done - begun) * 1e9 / (now_ns - begin_ns))

    def _describe(self) -> str:
        position = self._conductor.position
        if position is None:
            return "no environment yet"
        return (
            f"window {position.window.m}, {self._phase}, unit {position.unit}, "
            f"{self._ledger.counter('gradient_steps')} gradient steps, "
            f"policy {self._ledger.counter('last_version')}"
        )
