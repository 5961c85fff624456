"""One process of a peer's control loop; `act_path` starts two.

    python -m benchmarks.peer_loop server --transport zeromq --socket /tmp/x
    python -m benchmarks.peer_loop client --transport zeromq --socket /tmp/x --hz 500

The server answers a HalfCheetah observation with our policy's inference. The client stands where the env
server stands: a `Pacer`, and a `Step` message out and an `Action` in at each tick. Messages, network,
scheduling and cores are those of the real system; its checksum and validation are left out.
"""

from __future__ import annotations

import json
import sys
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import tyro

from agent_service.inference import TanhGaussianPolicy
from benchmarks.harness import LATE_SHARE, BenchmarkError, policy
from benchmarks.outcome import Outcome, share_above
from benchmarks.peers import WAITING, Answer, Send, Transport, connect, serve
from launcher.stealing import StealMeter
from rtcore import channels, realtime
from rtcore.clock import Clock
from rtcore.histogram import Histogram
from rtcore.lifecycle import Stop, die_with_parent, stop_on_signals
from rtcore.messages import Action, Step
from rtcore.monotonic import MonotonicClock
from rtcore.pacer import Pacer, Tick
from rtcore.spaces import Spaces
from rtcore.weights import verify

OBSERVATION_DIM, ACTION_DIM, POSITION_DIM = 17, 6, 9  # HalfCheetah
HIDDEN = (256, 256)
WARM_UP, WARM_UP_PAUSE_NS = 50, 5_000_000  # requests before the clock runs, and what lies between them
LEAD_NS = 50_000_000


@dataclass(frozen=True)
class Arguments:
    """Which half of which loop."""

    role: Annotated[Literal["server", "client"], tyro.conf.Positional]
    transport: Transport
    socket: Path
    hz: float = 500.0
    seconds: float = 10.0
    rt: Literal["auto", "off", "require"] = "auto"
    parent: int | None = None  # ends with this process


class Actor:
    """Answers a `Step` with an `Action`, as bytes."""

    def __init__(self, clock: Clock) -> None:
        made = policy(OBSERVATION_DIM, ACTION_DIM, HIDDEN)
        bound = np.ones(ACTION_DIM, np.float32)
        weights = verify(made, Spaces(OBSERVATION_DIM, ACTION_DIM))
        self._policy = TanhGaussianPolicy(1, made.architecture, weights, -bound, bound)
        self._rng = np.random.default_rng(0)
        self._clock = clock
        self._decode = msgspec.msgpack.Decoder(Step).decode
        self._encode = msgspec.msgpack.Encoder().encode

    def answer(self, request: bytes) -> bytes:
        """The action for an observation."""
        received_ns = self._clock.now_ns()
        step = self._decode(request)
        action = self._policy.act(np.frombuffer(step.observation, np.float32), self._rng)
        return self._encode(
            Action(
                env=step.env,
                incarnation=step.incarnation,
                tick=step.tick,
                values=action.tobytes(),
                policy_version=1,
                received_ns=received_ns,
                sent_ns=self._clock.now_ns(),
            )
        )


def make_step(tick: int, sent_ns: int, observation: bytes) -> Step:
    """A HalfCheetah step's fields at their sizes."""
    action = bytes(4 * ACTION_DIM)
    return Step(
        env="env0", incarnation=sent_ns, seq=tick, tick=tick, episode=1, episode_tick=1, unit=1,
        due_ns=sent_ns, woke_ns=sent_ns, sent_ns=sent_ns, observation=observation, reward=1.0,
        terminated=False, truncated=False, action=action, decision=action, answered_tick=tick,
        policy_version=1, missed=False, fallback="", cause="", skipped=0, loop_ns=1, reaction_ns=1,
        drift=1.0, position=bytes(8 * POSITION_DIM),
    )  # fmt: skip


class Asker:
    """The env server's part of a tick: look for the answer, send, and measure."""

    def __init__(self, clock: Clock, *, waits: bool) -> None:
        """`waits`: sending returns with the answer. If that took beyond the next deadline it is a miss,
        though the answer is there at the tick, which began late for it.
        """
        self._clock = clock
        self._waits = waits
        self._encode, self._decode = msgspec.msgpack.Encoder().encode, msgspec.msgpack.Decoder(Action).decode
        self._observation = np.linspace(-1, 1, OBSERVATION_DIM).astype(np.float32).tobytes()
        self._answers: deque[tuple[bytes, int]] = deque(maxlen=1)
        self._sent_ns: dict[int, int] = {}
        self._last = -1
        self.loop = Histogram()
        self.missed = 0

    def on_answer(self, answer: bytes) -> None:
        """Stamp and keep the newest answer; on whatever thread it comes."""
        self._answers.append((answer, self._clock.now_ns()))

    def warm_up(self, send: Send) -> None:
        """Ask until the connection stands and the caches are warm, before the clock runs."""
        for _ in range(WARM_UP):
            send(self._encode(make_step(0, self._clock.now_ns(), self._observation)))
            self._clock.sleep_until_ns(self._clock.now_ns() + WARM_UP_PAUSE_NS)
        if not self._answers:
            raise BenchmarkError("nothing was answered")
        self._answers.clear()

    def step(self, tick: Tick, send: Send) -> None:
        """One deadline."""
        answered, received_ns = self._take()
        in_time = answered == self._last and not (self._waits and received_ns > tick.due_ns)
        self.missed += self._last >= 0 and not in_time
        self._last = tick.index
        sent_ns = self._clock.now_ns()
        self._sent_ns[tick.index] = sent_ns
        send(self._encode(make_step(tick.index, sent_ns, self._observation)))

    def _take(self) -> tuple[int, int]:
        """The tick that the newest answer belongs to, and when it came; (-1, -1) without one. Its loop is
        recorded, late or not.
        """
        try:
            answer, received_ns = self._answers.pop()
        except IndexError:
            return -1, -1
        action = self._decode(answer)
        sent_ns = self._sent_ns.get(action.tick)
        if sent_ns is None:
            return -1, -1
        self.loop.record(received_ns - sent_ns)
        return action.tick, received_ns


def pace(asker: Asker, send: Send, clock: Clock, *, hz: float, seconds: float) -> Outcome:
    """Ask at each deadline. A tick that finds no answer to the one before is a miss, and so is every
    deadline that was lost, as when the sender waits for longer than a period.
    """
    period_ns = round(1e9 / hz)
    num_ticks = max(1, round(seconds * hz))
    pacer = Pacer(clock, t0_ns=clock.now_ns() + LEAD_NS, period_ns=period_ns, end_index=num_ticks)
    pacing, steal = Histogram(), StealMeter()
    for tick in pacer.ticks(Stop()):
        asker.step(tick, send)
        pacing.record(tick.woke_ns - tick.due_ns)
    return Outcome(
        ticks=pacer.executed,
        missed=asker.missed + pacer.skipped_total,
        overruns=pacer.overruns,
        loop_us=asker.loop.summary(1e-3),
        pacing_us=pacing.summary(1e-3),
        stolen_s=steal.elapsed_s(),
        more={"late_share": share_above(pacing, LATE_SHARE * period_ns)},
    )


def _serve(arguments: Arguments, answer: Answer) -> None:
    stop = Stop()
    with stop_on_signals(stop):
        serve(arguments.transport, arguments.socket, answer, stop, _say_ready)


def _say_ready() -> None:
    sys.stdout.write("ready\n")
    sys.stdout.flush()


def _measure(arguments: Arguments, clock: Clock) -> Outcome:
    asker = Asker(clock, waits=arguments.transport in WAITING)
    with connect(arguments.transport, arguments.socket, asker.on_answer) as send:
        asker.warm_up(send)
        return pace(asker, send, clock, hz=arguments.hz, seconds=arguments.seconds)


def main(arguments: Arguments) -> None:
    """Be the server until SIGTERM, or the client until its seconds are over."""
    if arguments.parent is not None:
        die_with_parent(arguments.parent)
    clock = MonotonicClock()
    if arguments.role == "server":
        actor = Actor(clock)
        realtime.enter(channels.AGENT, arguments.rt)  # before the transport: its threads inherit it
        _serve(arguments, actor.answer)
        return
    placement = realtime.enter(channels.ENV_SERVER, arguments.rt)
    found = _measure(arguments, clock).as_dict()
    found["more"]["placement"] = placement.describe()
    sys.stdout.write(json.dumps(found) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(tyro.cli(Arguments))
