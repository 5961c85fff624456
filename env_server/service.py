"""The env server: at each deadline take the newest action, turn the world, publish, wait for nobody."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from env_server import announcing
from env_server.accounts import Accounts, Latency
from env_server.actuation import Actuation, Rules
from env_server.announcing import Past
from env_server.blame import Blame, Miss
from env_server.journal import Journal
from env_server.rehearsal import Rehearsal
from env_server.rollout import Rollout, Turn
from env_server.wording import Stamp, unit_ns, word_spec, word_step
from env_server.worlds.period import tick_ns
from env_server.worlds.world import World
from rtcore import channels
from rtcore.bus import Bus, Received
from rtcore.clock import Clock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Action, Command, CommandReply, Step
from rtcore.pacer import Pacer, Tick

REMEMBERED_TICKS = 64  # sending times kept, so that a late answer's latency is known too
# Between two deadlines there are two, with the rehearsal's, unless this process was stalled.
ACTIONS_KEPT = 64
LONGEST_REST_S = 0.1  # how long the books wait for the answer, and a stop for the books
LAST_ANSWER_S = 0.1  # how long the end waits for the answer that tells why the last deadline was missed


@dataclass(frozen=True, slots=True)
class Observed:
    """An observation that was sent: of tick `tick`, whose deadline was `due_ns`, at `sent_ns`."""

    tick: int
    due_ns: int
    sent_ns: int


@dataclass(frozen=True, slots=True)
class Entry:
    """An executed tick, for the books.

    Attributes:
        heard: all that came from the agent since the tick before.
        asked: the observation that was to be answered; None at the first tick.
    """

    tick: Tick
    turn: Turn
    latency: Latency
    step: Step
    heard: Sequence[Received[Action]]
    asked: Observed | None


class EnvService:
    """One environment on its clock.

    In a process `run` does everything, while `journal.run` sends the log from another thread. In virtual
    time the driver calls `announce`, `step` for each of `pacer.ticks(stop)`, and now and then
    `journal.flush_due`. Both call `close` in the end.
    """

    def __init__(
        self,
        config: RunConfig,
        world: World,
        bus: Bus,
        clock: Clock,
        ledger: Ledger,
        incarnation: int,
        *,
        past: Past | None = None,
        resumed_ns: Callable[[], Sequence[int]] = tuple,
    ) -> None:
        """`config.env` is resolved (`worlds.resolve`), `world` is its world, `past` tells which env server of
        the run this is and when the run began, `resumed_ns` gives the instants at which this process was
        continued after a stop.
        """
        env = config.env
        self._config = config
        self._world = world
        self._bus = bus
        self._clock = clock
        self._ledger = ledger
        self._incarnation = incarnation
        self._past = past or Past()
        self._tick_ns = tick_ns(env)
        self._unit_ns = unit_ns(env)
        rules = Rules.of(env, world, incarnation=incarnation)
        self._rollout = Rollout(
            world,
            Actuation(rules),
            episode_steps=env.episode_steps,
            seed=config.seed,
            number=self._past.part.number,
            notify=env.notify,
        )
        self._specs = bus.publisher(channels.SPEC, env.name)
        self._steps = bus.publisher(channels.STEP, env.name)
        self._actions = bus.queue(channels.ACTION, env.name, capacity=ACTIONS_KEPT)
        self.journal = Journal(bus.publisher(channels.LOG, env.name), clock, ledger)
        self._heard: list[Received[Action]] = []
        self._accounts = Accounts(ledger)
        self._rehearsal = Rehearsal(self._steps, clock, self._tick_ns, fleet=env.count > 1)
        self._blame = Blame(self._tick_ns, resumed_ns)
        self._observed: deque[Observed] = deque(maxlen=REMEMBERED_TICKS)
        self._seq = 0
        self._pacer: Pacer | None = None
        self._t0_ns = 0

    @property
    def pacer(self) -> Pacer:
        """The run's deadlines; there are none before `announce`."""
        assert self._pacer is not None, "announce first"
        return self._pacer

    def run(self, stop: Stop) -> None:
        """Wait for the others, announce, and tick until stopped or until the duration is over."""
        self.wait_for_peers(stop)
        if stop.is_set():
            return
        self.announce()
        rest_s = min(self._tick_ns / 2e9, LONGEST_REST_S)
        for tick in self.pacer.ticks(stop):
            entry = self.act(tick)
            # The agent has the core until its answer is there; the books can wait.
            answered = self._await_answer(tick.index, rest_s)
            self.book(entry)
            if answered and not stop.is_set():
                self._rehearsal.perform(entry.step)
        if self._blame.open:
            self._actions.wait(LAST_ANSWER_S)

    def wait_for_peers(self, stop: Stop) -> None:
        """Wait for whom T0 waits for; see `announcing.wait_for_peers`."""
        announcing.wait_for_peers(self._config, self._past, self._bus, self._clock, self._ledger, stop)

    def announce(self) -> None:
        """Settle T0, declare the environment, and make the pacer: `duration_s` holds a fixed number of
        ticks.

        Raises:
            ConfigError: the run has begun, and when cannot be read.
        """
        env = self._config.env
        beginning = announcing.begin(
            self._config, self._past, self._clock, self._ledger, tick_ns=self._tick_ns
        )
        epoch = beginning.epoch
        self._t0_ns = epoch.t0_ns
        self._rollout.go_on_from(beginning.first_episode)
        self._accounts.begin(beginning.down)
        self._pacer = Pacer(
            self._clock,
            t0_ns=self._t0_ns,
            period_ns=self._tick_ns,
            first_index=beginning.first_index,
            end_index=beginning.end_index,
            beat=self._ledger.beat,
        )
        spec = word_spec(env, self._world, epoch, incarnation=self._incarnation, tick_ns=self._tick_ns)
        self._specs.put(spec)
        speed = "" if env.speed is None else f", {env.speed:g} times native speed"
        text = f"{env.id} at {1e9 / self._tick_ns:g} Hz{speed}"
        if epoch.lives > 1 or beginning.first_index > 0:
            text += f"; goes on at tick {beginning.first_index}, {beginning.down} passed meanwhile"
        self._ledger.event(self._clock.now_ns(), "INFO", text)

    def step(self, tick: Tick) -> None:
        """One deadline, and its books. Never waits."""
        self.book(self.act(tick))

    def act(self, tick: Tick) -> Entry:
        """What a deadline cannot wait with: take the newest action, turn the world, publish."""
        heard = self._listen()
        asked = self._observed[-1] if self._observed else None
        expected_tick = -1 if asked is None else asked.tick
        if len(heard) > 1:  # an answer is not lost to what comes after it and is none
            heard.sort(key=lambda received: self._rollout.answers(received.message, expected_tick))
        newest = heard[-1] if heard else None  # the older ones only tell why they come late
        unit = (tick.due_ns - self._t0_ns) // self._unit_ns
        turn = self._rollout.turn(
            None if newest is None else newest.message, unit, expected_tick=expected_tick
        )
        latency = Latency() if newest is None else self._latency(newest)
        position = self._world.position()
        stamp = Stamp(self._config.env.name, self._incarnation, self._seq, unit, self._clock.now_ns())
        step = word_step(stamp, tick, turn, latency, position)
        self._steps.put(step)
        self._observed.append(Observed(tick.index, tick.due_ns, step.sent_ns))
        self._seq += 1
        return Entry(tick, turn, latency, step, heard, asked)

    def book(self, entry: Entry) -> None:
        """Enter an executed tick into the ledger, and into the log all steps whose story is complete."""
        self._accounts.executed(entry.turn)
        self._hear(entry.heard, entry.step.tick)
        for received in entry.heard[:-1]:
            self._accounts.superseded(self._latency(received))
        self._log(self._blame.enter(entry.step, self._miss(entry)))
        self._accounts.tick(entry.tick, entry.turn, entry.latency, absent=self._blame.absent)

    def command(self, command: Command, stop: Stop) -> CommandReply:
        """Answer an operator; called on the bus's thread."""
        ok, text = True, "waiting for the agent and the learner"
        if command.verb == "stop":
            stop.set("stopped by command")
            text = "stopping"
        elif command.verb != "status":
            ok, text = False, f"the env server knows no '{command.verb}'"
        elif self._pacer is not None:
            names = ("ticks", "episodes", "missed")
            text = ", ".join(f"{self._ledger.counter(name)} {name}" for name in names)
        return CommandReply(id=command.id, ok=ok, text=text)

    def close(self) -> None:
        """Send what the log still holds, and that nothing follows."""
        if self._pacer is not None:
            self._accounts.close(self._pacer)
        heard = self._listen()
        self._hear(heard, self._observed[-1].tick + 1 if self._observed else 0)
        self._log(self._blame.finish())
        self.journal.close()

    def _await_answer(self, tick: int, timeout_s: float) -> bool:
        """Wait for the answer to observation `tick`, or for the time to pass; what comes is kept for the next
        deadline. A rehearsal's answer that comes late does not count: it would send the next rehearsal, and
        the books, in front of the real answer, tick after tick."""
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not any(received.message.tick == tick for received in self._heard):
            remaining_ns = until_ns - self._clock.now_ns()
            if remaining_ns <= 0 or not self._actions.wait(remaining_ns / 1e9):
                return False
            self._heard += self._drain()
        return True

    def _listen(self) -> list[Received[Action]]:
        """Everything that came and was not dealt with."""
        heard, self._heard = [*self._heard, *self._drain()], []
        return heard

    def _drain(self) -> list[Received[Action]]:
        return [received for received in self._actions.drain() if not received.message.rehearsal]

    def _hear(self, heard: Sequence[Received[Action]], tick: int) -> None:
        """Take note of what the agent said until tick `tick`."""
        for received in heard:
            action = received.message
            if action.incarnation == self._incarnation and action.tick < tick:
                observed = self._find(action.tick)
                self._blame.hear(received, None if observed is None else observed.sent_ns)
            else:  # of another run, or nonsense
                self._blame.notice()

    def _log(self, steps: Sequence[Step]) -> None:
        for step in steps:
            self.journal.append(step)
            if step.missed:
                self._accounts.miss(step.cause)

    @staticmethod
    def _miss(entry: Entry) -> Miss | None:
        if not entry.step.missed or entry.asked is None:
            return None
        return Miss(
            entry.asked.tick,
            due_ns=entry.asked.due_ns,
            sent_ns=entry.asked.sent_ns,
            missed_ns=entry.tick.due_ns,
            woke_ns=entry.tick.woke_ns,
            over_ns=entry.step.sent_ns,
            invalid=entry.turn.verdict == "invalid",
        )

    def _find(self, tick: int) -> Observed | None:
        return next((observed for observed in reversed(self._observed) if observed.tick == tick), None)

    def _latency(self, received: Received[Action]) -> Latency:
        """Of an answer that came late too: leaving those out would flatter the loop."""
        action = received.message
        observed = self._find(action.tick) if action.incarnation == self._incarnation else None
        if observed is None:
            return Latency()
        reaction_ns = max(0, action.sent_ns - action.received_ns)
        return Latency(max(0, received.received_ns - observed.sent_ns), reaction_ns)
