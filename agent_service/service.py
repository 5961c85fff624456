"""The agent: answer each observation where it arrives, swap policies in between."""

from __future__ import annotations

import threading

import numpy as np

from agent_service.adoption import Adoption, Past
from agent_service.evidence import Evidence
from agent_service.gate import Gate
from agent_service.inference import ActingPolicy, UniformPolicy
from agent_service.tables import UniformChoice
from rtcore import channels
from rtcore.admission import check_same_world
from rtcore.bus import Bus, Received
from rtcore.clock import Clock
from rtcore.config import RunConfig
from rtcore.epoch import this_boot
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Action, Command, CommandReply, Spec, Step
from rtcore.signing import Verifier

WAIT_S = 0.2  # how long a wait may last before `stop`, or a failure, is looked at
SPEC_POLL_S = 0.005
MAX_DECLARED = 256  # incarnations of the env server remembered, the newest
# An agent that starts again waits so long for a policy as new as its last one, before it acts on what it has.
# From a file one is there within milliseconds; the learner's link comes back after 100 ms or so.
PREPARE_S = 0.3
HANGS_NS = 1_000_000_000  # an answer takes under a millisecond
AGENT_STREAM = 1  # keeps the agent's random numbers apart from the world's and the learner's


class AgentService:
    """Answers every observation of one environment.

    It acts on the thread that receives: handing over to another one cost 60 to 90 us of a loop of 400 at
    200 Hz. In a process `run` begins it and `check_policies` works on a thread beside it; in virtual time
    the driver calls `attend` once, and `poll_policies`.
    """

    def __init__(
        self,
        config: RunConfig,
        bus: Bus,
        clock: Clock,
        ledger: Ledger,
        past: Past | None = None,
        evidence: Evidence | None = None,
        verifier: Verifier | None = None,
        *,
        number: int = 0,
    ) -> None:
        """`past` is what earlier lives leave to this one; `verifier` checks who signed a policy, None: nobody
        does; `number` is of its environment in a fleet, which explores apart from the others.
        """
        self._past = past or Past()
        self._last_published = self._past.newest
        self._prepared = threading.Event()
        name = config.env.name
        self._name = name
        self._bus = bus
        self._clock = clock
        self._verifier = verifier
        self._ledger = ledger
        self._rng = np.random.default_rng([config.seed, AGENT_STREAM, number])  # a last 0 changes nothing
        self._specs = bus.queue(channels.SPEC, name, capacity=MAX_DECLARED)
        self._policies = bus.queue(channels.POLICY, capacity=64)
        self._actions = bus.publisher(channels.ACTION, name)
        self._acting = threading.Lock()  # two links may deliver at once while one replaces the other
        self._failure: Exception | None = None
        self._closed = False
        self._acting_since_ns = 0  # 0: not acting
        self._hang_told = False
        self._evidence = evidence or Evidence(clock.now_ns)
        self._spec: Spec | None = None
        self._boot = ""
        self._gates: dict[int, Gate] = {}  # by incarnation
        self._policy: ActingPolicy | None = None
        self._adoption: Adoption | None = None
        self._reaction = ledger.histogram("reaction")
        self._publish_to_adopt = ledger.histogram("publish_to_adopt")

    def run(self, stop: Stop) -> None:
        """Get ready, with `check_policies` beside it; then act until stopped. What acting failed with is
        raised here."""
        self._prepared.wait(PREPARE_S)
        self.attend()
        while not stop.wait(WAIT_S):
            self.check()
            self._beat()
        self.check()

    def _beat(self) -> None:
        """Say that the agent lives, unless an answer takes so long that acting must hang."""
        now_ns, since_ns = self._clock.now_ns(), self._acting_since_ns
        if since_ns == 0 or now_ns - since_ns < HANGS_NS:
            self._ledger.beat(now_ns)
            self._hang_told = False
        elif not self._hang_told:
            self._hang_told = True
            text = f"an observation has been answered for {(now_ns - since_ns) / 1e9:.1f} s: acting hangs"
            self._ledger.event(now_ns, "ERROR", text)

    def check(self) -> None:
        """Raise what acting has failed with, if it has: nothing may be raised into the bus."""
        if self._failure is not None:
            raise self._failure

    def attend(self) -> None:
        """Answer every observation from now on, on the thread that receives it."""
        self._bus.attend(channels.STEP, self._name, self._answer)

    def check_policies(self, stop: Stop) -> None:
        """Check policies as they arrive, until stopped; for a thread beside `run`."""
        while not stop.is_set():
            self.poll_policies()
            if self._adoption is None:
                stop.wait(SPEC_POLL_S)
                continue
            if self._adoption.newest_version >= self._past.floor:
                self._prepared.set()
            self._policies.wait(WAIT_S)

    def poll_policies(self) -> None:
        """Check the policies that have arrived. Does nothing before the environment is known."""
        if not self._is_declared():
            return
        assert self._adoption is not None
        last_published, self._last_published = self._last_published, None
        policies = [received.message for received in self._policies.drain()]
        for policy in policies if last_published is None else [last_published, *policies]:
            self._evidence.checking.start()
            self._adoption.offer(policy, self._clock.now_ns())
            self._evidence.checking.stop()

    def act(self, received: Received[Step]) -> None:
        """Answer one observation; swap first, if a policy is ready."""
        step = received.message
        if not self._knows(step):
            self._ledger.count("observations.unknown")
            return
        fault = self._gates[step.incarnation].judge(step, received.received_ns)
        if step.rehearsal and not fault:
            self._respond(received)
            self._ledger.count("rehearsals")
            return
        self._ledger.count("observations")
        if fault:
            self._ledger.count(f"observations.{fault}")
            return
        self._respond(received)
        self._reaction.record(self._clock.now_ns() - received.received_ns)
        self._ledger.count("actions")

    def _respond(self, received: Received[Step]) -> None:
        """The path from an observation to its action, which a rehearsal takes too: so a swap, and what is
        cold after it, are paid for between two ticks."""
        step = received.message
        self._swap(step)
        assert self._policy is not None
        action = self._policy.act(np.frombuffer(step.observation, np.float32), self._rng)
        excuse = self._evidence.excuse(received.received_ns, settle=not step.rehearsal)
        self._actions.put(
            Action(
                env=step.env,
                incarnation=step.incarnation,
                tick=step.tick,
                values=action.tobytes(),
                policy_version=self._policy.version,
                received_ns=received.received_ns,
                sent_ns=self._clock.now_ns(),
                swap_ns=excuse.swap_ns,
                collector_ns=excuse.collector_ns,
                starved_ns=excuse.starved_ns,
                resumed_ns=excuse.resumed_ns,
                since_ns=excuse.since_ns,
                rehearsal=step.rehearsal,
            )
        )

    def command(self, command: Command) -> CommandReply:
        """Answer an operator; called on the bus's thread."""
        if command.verb != "status":
            return CommandReply(id=command.id, ok=False, text=f"the agent knows no '{command.verb}'")
        version = self._policy.version if self._policy is not None else "none"
        text = f"policy {version}, {self._ledger.counter('actions')} actions"
        return CommandReply(id=command.id, ok=True, text=text)

    def close(self) -> None:
        """Account for a policy that was ready and never acted."""
        with self._acting:  # the bus still delivers: nothing is adopted after the count
            self._closed = True
            if self._adoption is not None and self._adoption.take() is not None:
                self._ledger.count("policies.unused")

    def _answer(self, received: Received[Step]) -> None:
        if not self._acting.acquire(blocking=False):
            self._ledger.count("observations")
            self._ledger.count("observations.superseded")
            return
        try:
            self._acting_since_ns = received.received_ns
            if self._failure is None and not self._closed:
                self.act(received)
        except Exception as error:  # noqa: BLE001 - nothing may be raised into the bus; `check` raises it
            self._failure = error
        finally:
            self._acting_since_ns = 0
            self._acting.release()

    def _swap(self, step: Step) -> None:
        assert self._adoption is not None
        ready = self._adoption.take()
        if ready is None:
            return
        self._evidence.swapping.start()
        self._policy, policy = ready
        now_ns = self._clock.now_ns()
        if policy.version > self._past.known:  # another says how long the agent was away
            self._publish_to_adopt.record(max(0, now_ns - policy.created_ns))
        self._ledger.count("policies.adopted")
        self._ledger.gauge("policy_version", policy.version)
        self._ledger.event(
            now_ns, "DEBUG", f"policy {policy.version} (window {policy.window}, iterate {policy.iterate}) "
            f"acts after tick {step.tick}"
        )  # fmt: skip
        self._evidence.swapping.stop()

    def _is_declared(self) -> bool:
        """Whether an environment has declared itself; for a thread that does not act, so that policies are
        ready before the first observation comes."""
        if self._adoption is None:
            with self._acting:
                self._take_declaration()
        return self._adoption is not None

    def _knows(self, step: Step) -> bool:
        """Whether the environment behind `step` has declared itself; takes its declaration if new."""
        if step.incarnation not in self._gates:
            self._take_declaration()
        return step.incarnation in self._gates

    def _take_declaration(self) -> None:
        for declared in self._specs.drain():
            self._meet(declared.message)

    def _meet(self, spec: Spec) -> None:
        if self._spec is None:
            low, high = np.asarray(spec.action_low, np.float32), np.asarray(spec.action_high, np.float32)
            self._policy = UniformChoice(spec.actions) if spec.states else UniformPolicy(low, high)
            self._adoption = Adoption(spec, self._ledger, self._verifier, self._past)
            self._spec, self._boot = spec, this_boot()
        try:
            check_same_world(spec, self._spec)  # a later one is the same world in a new incarnation
        except ValueError as error:
            self._bus.reject(channels.SPEC, error)
            return
        self._gates[spec.incarnation] = Gate(spec, self._boot)
        if len(self._gates) > MAX_DECLARED:
            del self._gates[min(self._gates)]
