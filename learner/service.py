"""The learner's loop: take what the world did, improve, forecast and publish when it is time.

One thread trains; messages arrive on the bus's threads and leave through the outbox's. `step` is one
turn of the loop and never waits; `run` repeats it in a process, `catch_up` in virtual time.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import assert_never

from learner import meeting, resume
from learner.algorithm import Algorithm
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
from learner.gauges import Gauges
from learner.intakes import Intakes, Taken
from learner.keeper import Keeper
from learner.orders import Orders
from learner.outbox import Outbox
from learner.place import Course
from learner.power import Levers, PowerControl
from learner.publication import Publication
from learner.schedule.scheduler import Scheduler
from rtcore import epoch
from rtcore.bus import Bus
from rtcore.cast import env_names
from rtcore.clock import Clock
from rtcore.config import TABULAR, RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Command, CommandReply, Phase, Spec, Step
from rtcore.run_dir import RunDir
from rtcore.signing import Signer

IDLE_WAIT_S = 0.02  # nothing to learn from: wait so long for the next batch (they come every 50 ms)
DRAIN_LIMIT_S = 2.0  # after the stop: wait so long for the env servers' last batches
LEAD_FLOOR_NS = 50_000_000  # publish at least so long before the unit ends, or a quarter of a shorter unit
COUNTED = ("gradient_steps", "policy_steps", "unread")  # of the algorithm, into the ledger


class LearnerService:
    """Trains on the logs of all environments of a run."""

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
        self.outbox = Outbox(bus, run_dir, clock, ledger, signer)
        self._intake = Intakes(bus, env_names(config.env), clock, ledger, self.outbox.diary)
        directory = run_dir.learner_dir / resume.CHECKPOINT_DIR
        self.keeper = Keeper(directory, config.learner.checkpoint_s, clock, ledger)
        kept = run_dir.learner_dir / resume.SCHEDULE_FILE
        self._scheduler = Scheduler(config, clock, ledger, lambda data: self.outbox.keep(kept, data))
        self._conductor = Conductor(self._scheduler.windows)
        self._orders = Orders(self._conductor, self._scheduler, clock, ledger)
        self._budget = (TableBudget if config.learner.algo in TABULAR else UpdateBudget)(config.learner)
        self._power = PowerControl(config.learner, levers, ledger)
        self._gauges = Gauges(ledger)
        self._publication = Publication(config.learner.algo, self.outbox, ledger)
        self._spec: Spec | None = None
        self._unit_ended = False  # since the last look at the schedule
        self._on_time = False  # the learner was there before T0: the first window begins on the dot
        self._algorithm: Algorithm | None = None
        self._lead_ns = self._lead_floor_ns = LEAD_FLOOR_NS

    def run(self, stop: Stop) -> None:
        """Learn until stopped, then take what the env servers still send."""
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
        self._learn_from(self._intake.finish())
        self._commit()
        self._publication.check()
        if self._algorithm is not None:
            self._report(self._algorithm)
            self.keeper.finish(resume.state(self._algorithm, self._budget))

    # ---- turning the crank

    def _take_in(self) -> None:
        if self._spec is None:
            spec = self._intake.declared()
            if spec is None:
                return
            now_ns, wall_ns = self._clock.now_ns(), time.time_ns()
            self._meet(epoch.on_this_clock(spec, now_ns=now_ns, wall_ns=wall_ns, boot_id=epoch.this_boot()))
        now_ns = self._clock.now_ns()
        self._power.watch(self._learn_from(self._intake.take(now_ns)), now_ns)

    def _learn_from(self, parts: Iterable[Taken]) -> list[Step]:
        steps: list[Step] = []
        for learned, part in parts:
            if learned:
                self._budget.earn(learned, self._phase)
            self._commit()
            self._ledger.beat(self._clock.now_ns())  # there may be many
            steps += part
        return steps

    def _commit(self) -> None:
        """Let everything until now survive a kill, the algorithm's own state aside."""
        conductor = self._conductor
        self._intake.commit(Course(self._budget.earned, conductor.settled, conductor.paused))

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
        found = meeting.meet(
            self._config, self._run_dir, spec, self._budget, self._clock, self._ledger
        )  # or it ends here: what does not fit stays as it is
        self._ledger.beat(self._clock.now_ns())  # what earlier ones left may take long to load
        self._spec, self._algorithm = spec, found.algorithm
        self._lead_ns = self._lead_floor_ns = min(LEAD_FLOOR_NS, spec.unit_ns // 4)
        self._power.meet(spec.tick_ns, self._intake.envs, self._clock.now_ns())
        self._intake.meet(spec, found.replay, found.place, found.counted)
        self.keeper.meet(found.replay)
        self._conductor.go_on_from(found.settled, paused=found.place.course.paused)
        self._publication.go_on_from(found.published.version)
        if found.published.policy is not None:
            self.outbox.republish(found.published.policy)
        self._scheduler.meet(found.algorithm, resume.timetable(self._run_dir))
        self._commit()

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
        if self._gauges.due(now_ns) and self._algorithm is not None:
            self._report(self._algorithm)
            self._gauges.report_rate(now_ns)
        if self.keeper.due(now_ns) and (self._unit_ended or spec.unit_ns > self.keeper.period_ns):
            self._checkpoint()
        self._unit_ended = False

    def _checkpoint(self) -> None:
        assert self._algorithm is not None
        begin_ns = self._clock.now_ns()
        self.keeper.offer(resume.state(self._algorithm, self._budget), begin_ns)
        self._ledger.gauge("checkpoint/pause_ms", (self._clock.now_ns() - begin_ns) / 1e6)

    def _handle_all(self, happenings: Iterable[Happening], spec: Spec) -> None:
        """Each in its turn: what comes next may follow from it."""
        for happening in happenings:
            self._handle(happening, spec)

    def _handle(self, happening: Happening, spec: Spec) -> None:
        assert self._algorithm is not None
        match happening:
            case UnitEnded(unit):
                self._algorithm.end_unit(unit)
                self._unit_ended = True
            case WindowEntered(window, unit):
                self._algorithm.begin_window(window, unit)
                self.outbox.diary.window(window, unit, self._algorithm)
                self._scheduler.entered(window)
            case PhaseEntered():
                self._commit()  # an operator's hold, for one
                self._publication.announce(happening, spec)
            case PublishDue():
                self._handle_all(self._orders.carry_out(spec.t0_ns), spec)  # what came before comes first
                self._commit()  # that it is settled
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
            self._publication.publish(algorithm, due, spec, self._clock)
        else:
            self._publication.withhold(due.window.m, due.iterate, self._clock.now_ns())

    def _iterate(self, algorithm: Algorithm, g: int) -> None:
        before = algorithm.policy_steps
        self._publication.improved |= algorithm.iterate(g)
        self._ledger.count("policy_steps", algorithm.policy_steps - before)

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

    def _report(self, algorithm: Algorithm) -> None:
        self._gauges.report(algorithm, self._intake.replay_size)
        self._power.report()

    def _describe(self) -> str:
        position = self._conductor.position
        if position is None:
            return "no environment yet"
        return (
            f"window {position.window.m}, {self._phase}, unit {position.unit}, "
            f"{self._ledger.counter('gradient_steps')} gradient steps, "
            f"policy {self._ledger.counter('last_version')}"
        )
