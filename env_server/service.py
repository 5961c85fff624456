"""The env server: at each deadline take the newest action, turn the world, publish, wait for nobody."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from env_server.accounts import Accounts, Latency
from env_server.actuation import Actuation, Rules
from env_server.journal import Journal
from env_server.period import tick_ns
from env_server.rollout import Rollout
from env_server.wording import Stamp, unit_ns, word_spec, word_step
from env_server.world import World
from rtcore import channels
from rtcore.bus import Bus, Received
from rtcore.clock import Clock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.messages import Action, Command, CommandReply
from rtcore.pacer import Pacer, Tick

LEAD_NS = 100_000_000  # from announcing T0 to T0, so that the spec is with everybody before step 0
PEERS = frozenset({channels.AGENT, channels.LEARNER})  # whom T0 waits for
PEERS_POLL_S = 0.05
REMEMBERED_TICKS = 64  # sending times kept, so that a late answer's latency is known too


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
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """`config.env` is resolved (`worlds.resolve`), `world` is its world, `wall_ns` Unix time."""
        env = config.env
        self._config = config
        self._world = world
        self._bus = bus
        self._clock = clock
        self._ledger = ledger
        self._incarnation = incarnation
        self._wall_ns = wall_ns
        self._tick_ns = tick_ns(env)
        self._unit_ns = unit_ns(env)
        rules = Rules.of(env, world, tick_ns=self._tick_ns, incarnation=incarnation)
        self._rollout = Rollout(world, Actuation(rules), episode_steps=env.episode_steps, seed=config.seed)
        self._specs = bus.publisher(channels.SPEC, env.name)
        self._steps = bus.publisher(channels.STEP, env.name)
        self._actions = bus.latest(channels.ACTION, env.name)
        self.journal = Journal(bus.publisher(channels.LOG, env.name), clock, ledger)
        self._accounts = Accounts(ledger)
        self._sent: deque[tuple[int, int]] = deque(maxlen=REMEMBERED_TICKS)  # (tick, sent_ns)
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
        for tick in self.pacer.ticks(stop):
            self.step(tick)

    def wait_for_peers(self, stop: Stop) -> None:
        """Wait until an agent and a learner are there, `env.start_wait_s` at most."""
        wait_s = self._config.env.start_wait_s
        limit_ns = self._clock.now_ns() + round(wait_s * 1e9)
        while missing := PEERS - self._bus.alive():
            now_ns = self._clock.now_ns()
            if now_ns >= limit_ns:
                names = " and ".join(sorted(missing))
                self._ledger.event(now_ns, "WARN", f"starting without {names} after {wait_s:g} s")
                return
            if stop.wait(min(PEERS_POLL_S, (limit_ns - now_ns) / 1e9)):
                return

    def announce(self) -> None:
        """Set T0, declare the environment, and make the pacer: `duration_s` holds a fixed number of ticks."""
        env = self._config.env
        now_ns = self._clock.now_ns()
        self._t0_ns = now_ns + LEAD_NS
        num_ticks = max(1, round(self._config.duration_s * 1e9 / self._tick_ns))
        end_index = num_ticks if self._config.duration_s > 0 else None
        self._pacer = Pacer(self._clock, t0_ns=self._t0_ns, period_ns=self._tick_ns, end_index=end_index)
        spec = word_spec(
            env,
            self._world,
            incarnation=self._incarnation,
            t0_ns=self._t0_ns,
            wall_t0_ns=self._wall_ns() + LEAD_NS,
            tick_ns=self._tick_ns,
        )
        self._specs.put(spec)
        speed = "" if env.speed is None else f", {env.speed:g} times native speed"
        self._ledger.event(now_ns, "INFO", f"{env.id} at {1e9 / self._tick_ns:g} Hz{speed}")

    def step(self, tick: Tick) -> None:
        """One deadline. Never waits."""
        received = self._actions.take()
        unit = (tick.due_ns - self._t0_ns) // self._unit_ns
        last_tick, last_sent_ns = self._sent[-1] if self._sent else (-1, tick.woke_ns)
        turn = self._rollout.turn(
            None if received is None else received.message,
            unit,
            expected_tick=last_tick,
            answer_time_ns=tick.woke_ns - last_sent_ns,
        )
        latency = self._latency(received)
        position = self._world.position()
        stamp = Stamp(self._config.env.name, self._incarnation, self._seq, unit, self._clock.now_ns())
        step = word_step(stamp, tick, turn, latency, position)
        self._steps.put(step)
        self.journal.append(step)
        self._sent.append((tick.index, step.sent_ns))
        self._seq += 1
        self._accounts.tick(tick, turn, latency)

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
        self.journal.close()

    def _latency(self, received: Received[Action] | None) -> Latency:
        """Of an answer that came late too: leaving those out would flatter the loop."""
        if received is None or received.message.incarnation != self._incarnation:
            return Latency()
        action = received.message
        for tick, sent_ns in reversed(self._sent):
            if tick == action.tick:
                reaction_ns = max(0, action.sent_ns - action.received_ns)
                return Latency(max(0, received.received_ns - sent_ns), reaction_ns)
        return Latency()
