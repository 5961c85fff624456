"""A rogue in a process of its own: overhears a run, then floods every channel with what must have no effect.

    python -m tests.fuzz.flooder RUN_DIR --messages 100000 --per-second 2000

That is mutations of what it heard that the codec, which all readers share, refuses, and what it heard once
more. A mutation that is a right message is not sent: without keys it would be believed. Prints one JSON
object: what it sent, what of that must be refused, and how the env server ran by its own log, before the
flood and during it.
"""

from __future__ import annotations

import argparse
import json
import logging
import random
import sys
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec
import zenoh
from zenoh import handlers

from rtcore import zenoh_config
from rtcore.bus import QueueReader
from rtcore.channels import CONTROL_KEY, PROCESSES, TABLE, Channel
from rtcore.codec import Codec, Rejections, name_in, seal
from rtcore.commands import CONTROL, CommandServer
from rtcore.config import ScheduleConfig
from rtcore.messages import Command, CommandReply, Message, Step, StepBatch
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import ZenohBus, open_bus
from tests.fuzz.mutations import Mutator, mutate_command

PATIENCE_S = 30.0
QUIET_S = 20.0  # the longest stretch before a flood
NAP_S = 0.005
LINGER_S = 0.5  # a step is in the log some ticks, and a batch of 50 ms, after its deadline
UNANSWERED = 64  # queries at a time
HUGE = 8 << 20  # bytes, on the channels of the loop, where the largest message has 30 kB


class Ear:
    """What the true processes say: a session does not hear what it puts for the others alone.

    Attributes:
        heard: the newest payloads by key.
        steps: of the env server's log.
    """

    def __init__(self, bus: ZenohBus) -> None:
        self.heard: dict[str, deque[bytes]] = defaultdict(lambda: deque(maxlen=32))
        self.steps: list[Step] = []
        self._readers: list[tuple[Channel[Any], QueueReader[Any]]] = [
            (channel, bus.queue(channel, "*" if "{name}" in channel.key else "")) for channel in TABLE
        ]

    def listen(self) -> None:
        """Take in what has come."""
        for channel, reader in self._readers:
            for received in reader.drain():
                message = received.message
                if isinstance(message, StepBatch):
                    self.steps += message.steps
                self.heard[channel.key_for(_name(message))].append(seal(msgspec.msgpack.encode(message)))

    def complete(self) -> bool:
        """Whether every channel was heard."""
        return len({channel_of(key).name for key in self.heard}) == len(TABLE)

    def listen_until(self, happened: Callable[[], bool]) -> None:
        """Take in what comes until then."""
        deadline = time.monotonic() + PATIENCE_S
        while not happened():
            if time.monotonic() > deadline:
                sys.exit(f"in {PATIENCE_S:g} s it came to nothing; heard: {sorted(self.heard)}")
            time.sleep(NAP_S)
            self.listen()


class Control:
    """Mutated commands to all processes: those that are refused, and questions for the status."""

    def __init__(self, session: zenoh.Session, rng: random.Random) -> None:
        self._session = session
        self._rng = rng
        self._slots = threading.Semaphore(UNANSWERED)
        self._answered = 0
        verbs = get_args(get_type_hints(Command)["verb"])
        self._true = [msgspec.msgpack.encode(Command(id=verb, verb=verb)) for verb in verbs]
        schedule = Command(id="s", verb="schedule", schedule=ScheduleConfig())
        self._true.append(msgspec.msgpack.encode(schedule))

    def send(self) -> tuple[str, bool]:
        """Ask one process; its name, and whether it must refuse."""
        name, payload = self._rng.choice(PROCESSES), mutate_command(self._rng, self._true)
        while (command := understood(payload)) is not None and command.verb != "status":
            payload = mutate_command(self._rng, self._true)  # any other would be carried out
        self._slots.acquire(timeout=PATIENCE_S)
        self._session.get(
            CONTROL_KEY.format(name=name),
            handlers.Callback(self._on_reply, self._slots.release, indirect=False),
            payload=payload,
            target=zenoh.QueryTarget.ALL,
            timeout=PATIENCE_S,
        )
        return name, command is None

    def finish(self) -> int:
        """Wait for the end of all; how many were answered."""
        for _ in range(UNANSWERED):
            self._slots.acquire(timeout=PATIENCE_S)
        return self._answered

    def _on_reply(self, reply: zenoh.Reply) -> None:
        self._answered += reply.ok is not None


class Flooder:
    """Sends, and counts by channel what it sent and what must be refused; for `control` by process."""

    def __init__(self, session: zenoh.Session, ear: Ear, seed: int) -> None:
        self._ear = ear
        self._rng = random.Random(seed)
        self._mutator = Mutator(self._rng)
        self.control = Control(session, self._rng)
        self.sent: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self._codecs = {key: Codec(channel_of(key), Rejections(lambda: 0), name_in(key)) for key in ear.heard}
        self._publishers: dict[str, Any] = {key: _publisher(session, key) for key in ear.heard}

    def matched(self) -> bool:
        """Whether somebody hears each key."""
        return all(publisher.matching_status.matching for publisher in self._publishers.values())

    def flood(self, n: int, per_second: float) -> None:
        """Send `n` messages, no faster than `per_second`; first what is too large, on each channel."""
        for key in self._publishers:
            self._put(key, bytes(channel_of(key).max_bytes + 1))
            if channel_of(key).name in ("step", "action"):
                self._put(key, bytes(HUGE))
        begin = time.monotonic()
        while (done := self.sent.total()) < n:
            due = min(n, round((time.monotonic() - begin) * per_second)) - done
            for _ in range(due):
                self._send_one()
            time.sleep(NAP_S)
            self._ear.listen()

    def _send_one(self) -> None:
        name = self._rng.choice((*(channel.name for channel in TABLE), CONTROL))
        if name == CONTROL:
            process, refused = self.control.send()
            self.sent[f"{CONTROL}/{process}"] += 1
            self.refused[f"{CONTROL}/{process}"] += refused
            return
        key = self._rng.choice([key for key in self._publishers if channel_of(key).name == name])
        true = self._ear.heard[key]
        others = [payloads[-1] for payloads in self._ear.heard.values()]
        payload = self._mutator.mutate(true, others, channel_of(key).max_bytes)
        if not self._is_refused(key, payload):
            payload = self._rng.choice(true)
        self._put(key, payload)

    def _put(self, key: str, payload: bytes) -> None:
        name = channel_of(key).name
        self._publishers[key].put(payload)
        self.sent[name] += 1
        self.refused[name] += self._is_refused(key, payload)

    def _is_refused(self, key: str, payload: bytes) -> bool:
        codec = self._codecs[key]
        return not codec.fits(len(payload)) or codec.decode(payload) is None


def channel_of(key: str) -> Channel[Any]:
    """The channel that a key is of."""
    return next(one for one in TABLE if key == one.key_for(name_in(key)))


def understood(payload: bytes) -> Command | None:
    """The command that a process finds in the payload."""
    found: list[Command] = []

    def keep(command: Command) -> CommandReply:
        found.append(command)
        return CommandReply(id=command.id, ok=True, text="")

    CommandServer(keep, Rejections(lambda: 0)).answer(payload)
    return found[0] if found else None


def course(steps: Sequence[Step], begin_ns: int, end_ns: int) -> dict[str, float]:
    """How the env server ran in between: ticks, those left out and missed; how late a tick was at most, and
    the longest time from one to the next, in ms."""
    within = [step for step in steps if begin_ns <= step.due_ns < end_ns]
    return {
        "ticks": len(within),
        "deadlines": within[-1].tick - within[0].tick + 1,
        "skipped": sum(step.skipped for step in within[1:]),
        "missed": sum(step.missed for step in within),
        "late_ms": max(step.woke_ns - step.due_ns for step in within) / 1e6,
        "gap_ms": max(later.woke_ns - earlier.woke_ns for earlier, later in pairwise(within)) / 1e6,
    }


def _name(message: Message) -> str:
    """The environment or process in the key of a message."""
    if isinstance(message, StepBatch):
        return message.steps[0].env
    name: str = getattr(message, "env", "") or getattr(message, "process", "")
    return name


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """Nothing that it puts may be lost on the way, or the accounts are no accounts."""
    return session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.BLOCK, allowed_destination=zenoh.Locality.REMOTE
    )


def main() -> None:
    """Overhear for as long as the flood should last, flood, and tell."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("--messages", type=int, required=True)
    parser.add_argument("--per-second", type=float, required=True)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)  # what it finds refused itself
    run, clock = RunDir.open(arguments.run), MonotonicClock()
    # A link that is given up takes messages with it: rather wait for a reader that gets no core.
    zenoh_config.BLOCK_US = round(PATIENCE_S * 1e6)
    with open_bus("client", run.run_name, run.socket_dir(), clock=clock) as bus:
        ear = Ear(bus)
        ear.listen_until(ear.complete)
        flooder = Flooder(bus._session, ear, arguments.seed)
        ear.listen_until(flooder.matched)
        quiet_s = min(arguments.messages / arguments.per_second, QUIET_S)
        begin_ns = clock.now_ns() + round(1e9 * quiet_s)
        ear.listen_until(lambda: clock.now_ns() >= begin_ns)
        begin_ns = clock.now_ns()
        flooder.flood(arguments.messages, arguments.per_second)
        answered = flooder.control.finish()
        end_ns = clock.now_ns()
        ear.listen_until(lambda: clock.now_ns() >= end_ns + LINGER_S * 1e9)
    told = {
        "sent": flooder.sent,
        "refused": flooder.refused,
        "answered": answered,
        "seconds": (end_ns - begin_ns) / 1e9,
        "quiet": course(ear.steps, 2 * begin_ns - end_ns, begin_ns),
        "attacked": course(ear.steps, begin_ns, end_ns),
    }
    sys.stdout.write(f"{json.dumps(told)}\n")


if __name__ == "__main__":
    main()
