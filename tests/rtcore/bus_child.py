"""A process for the bus tests to kill: `python -m tests.rtcore.bus_child DEED ROLE SOCKET_DIR [INCARNATION]`.

Prints one line once it is connected, then does its deed until it is stopped.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from rtcore.bus import Bus
from rtcore.channels import ACTION, LOG, SPEC, STEP
from rtcore.monotonic import MonotonicClock
from rtcore.zenoh_bus import open_bus
from tests.rtcore.bus_samples import ENV, ZenohWorld, action, batch, spec

BATCHES = 400  # per incarnation, in 0.8 s


def publish(bus: Bus, incarnation: int) -> None:
    """An env server: a spec, then numbered batches."""
    bus.publisher(SPEC, ENV).put(spec())
    log = bus.publisher(LOG, ENV)
    print("ready", flush=True)
    for seq in range(BATCHES):
        log.put(batch(incarnation * 1000 + seq, incarnation))
        time.sleep(0.002)
    time.sleep(60)


def read(bus: Bus, incarnation: int) -> None:
    """A recorder: prints the numbers of all batches."""
    reader = bus.queue(LOG, ENV)
    print("ready", flush=True)
    while True:
        reader.wait(0.1)
        for received in reader.drain():
            print(*(s.seq for s in received.message.steps), flush=True)


def answer(bus: Bus, incarnation: int) -> None:
    """An agent: answers each observation with its tick."""
    steps, actions = bus.latest(STEP, ENV), bus.publisher(ACTION, ENV)
    print("ready", flush=True)
    while True:
        received = steps.wait(0.1)
        if received is not None:
            actions.put(action(tick=received.message.tick))


def leave(bus: Bus, incarnation: int) -> None:
    """Ends in order with all sorts of things declared; says how many receiving threads it had."""
    bus.queue(LOG, ENV)
    bus.latest(STEP, ENV)
    bus.publisher(LOG, ENV).put(batch(1))
    time.sleep(0.2)  # a thread gives itself its name
    names = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
    print(sum(name.startswith("rx-") for name in names), flush=True)


def fail(bus: Bus, incarnation: int) -> None:
    """Ends with an exception."""
    bus.queue(LOG, ENV)
    raise RuntimeError("on purpose")


DEEDS = {deed.__name__: deed for deed in (publish, read, answer, leave, fail)}


def main() -> None:
    deed, role, socket_dir = sys.argv[1:4]
    incarnation = int(sys.argv[4]) if len(sys.argv) > 4 else 1
    secure = sys.argv[5] if len(sys.argv) > 5 else ""
    with open_bus(role, ZenohWorld.RUN, Path(socket_dir), clock=MonotonicClock(), secure=secure) as bus:
        bus.declare_alive(role)
        DEEDS[deed](bus, incarnation)


if __name__ == "__main__":
    main()
