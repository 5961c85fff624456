"""A learner in a process of its own, fed with recorded arrivals in virtual time, killed and started again.

    python -m tests.learner.arrivals_child RUN ARRIVALS LIVES

Each life is a fork. It begins with what the env server's cache would have for it, goes on with the arrivals
that no earlier life has seen, and is killed by signal 9 at the planned instant; the last one ends in order.
Prints how each life ended, as JSON.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import msgspec

from learner.marks import Marks
from learner.service import LearnerService
from rtcore import channels
from rtcore.bus import Publisher
from rtcore.cast import env_names, offset_ns
from rtcore.clock import VirtualClock
from rtcore.ledger import Ledger
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Policy, Spec, StepBatch
from rtcore.run_dir import RunDir
from rtcore.tally import Tally

PROGRESS, PUBLISHED = "progress", "published"
WITHIN = 25  # arrivals: by then a life has ended, if its own instant has not come
ROOT = Path(__file__).parents[2]
TRACED = tuple(f"{ROOT}/{part}" for part in ("learner/", "rtcore/files.py", "rtcore/tally.py"))


class Arrivals(msgspec.Struct):
    """What came when."""

    spec: Spec
    batches: list[tuple[int, StepBatch]]


class Life(msgspec.Struct):
    """When and how one life ends: `count` lines, marks or microseconds after the arrival number `at`."""

    at: int
    way: str  # "line", "mark" or "timer"
    count: int
    cut: int = 0  # of a mark: bytes of it that are still written


@dataclass
class Files:
    """What the world outside the learner knows, whoever is killed."""

    run: RunDir

    @property
    def seen(self) -> int:
        """Arrivals that the env server has sent so far."""
        path = self.run.path / PROGRESS
        return int.from_bytes(path.read_bytes(), "little") if path.exists() else 0

    def see(self, count: int) -> None:
        (self.run.path / PROGRESS).write_bytes(count.to_bytes(4, "little"))

    def publish(self, policy: Policy) -> None:
        with (self.run.path / PUBLISHED).open("a") as file:
            file.write(f"{policy.version} {policy.window} {policy.iterate} {policy.sha256}\n")


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(60)


class Torn:
    """A mapping whose n-th store is cut off by the kill."""

    def __init__(self, mapped: Any, life: Life) -> None:
        self._mapped, self._life, self._stores = mapped, life, 0

    def __setitem__(self, at: slice, data: bytes) -> None:
        self._stores += 1
        if self._stores == self._life.count:
            kept = min(self._life.cut, len(data))
            self._mapped[at.start : at.start + kept] = data[:kept]
            die()
        self._mapped[at] = data


def arm(life: Life, marks: Marks) -> None:
    """From now on, the end is near."""
    if life.way == "timer":
        threading.Timer(life.count / 1e6, die).start()
    elif life.way == "mark":
        marks._mapped = Torn(marks._mapped, life)  # type: ignore[assignment]
    else:
        left = [life.count]

        def trace(frame: FrameType, event: str, arg: object) -> Any:
            del arg
            if not frame.f_code.co_filename.startswith(TRACED):
                return None
            if event == "line":
                left[0] -= 1
                if left[0] == 0:
                    die()
            return trace

        sys.settrace(trace)


def live(run: RunDir, arrivals: Arrivals, life: Life | None) -> None:
    """One life, to its end."""
    files = Files(run)
    begin = files.seen
    now_ns = arrivals.batches[max(0, begin - 1)][0] + (begin > 0) * 30_000_000  # the outage takes some time
    clock, hub = VirtualClock(now_ns), MemoryHub()
    logs: dict[tuple[str, int], Publisher[StepBatch]] = {}
    names = env_names(run.config().env)

    def send(batch: StepBatch) -> None:
        """By a publisher of each life of an env server, whose cache can be reached for ever."""
        name, incarnation = life = batch.steps[0].env, batch.steps[0].incarnation
        if life not in logs:
            env = hub.bus(channels.ENV_SERVER, clock)
            t0_ns = arrivals.spec.t0_ns + offset_ns(names.index(name), len(names), arrivals.spec.tick_ns)
            spec = msgspec.structs.replace(arrivals.spec, env=name, incarnation=incarnation, t0_ns=t0_ns)
            env.publisher(channels.SPEC, name).put(spec)
            logs[life] = env.publisher(channels.LOG, name)
        logs[life].put(batch)

    for _, batch in arrivals.batches[:begin]:
        send(batch)
    number = run.next_incarnation(channels.LEARNER, 1)
    ledger = Ledger(channels.LEARNER, number, Tally.create(run.tally_path(channels.LEARNER, number)))
    policies = hub.bus(channels.AGENT, clock).queue(channels.POLICY)
    learner = LearnerService(run.config(), run, hub.bus(channels.LEARNER, clock), clock, ledger)
    learner.catch_up()
    for index in range(begin, len(arrivals.batches)):
        at_ns, batch = arrivals.batches[index]
        while clock.now_ns() < at_ns - arrivals.spec.tick_ns:  # it keeps its schedule in between as well
            clock.advance_ns(arrivals.spec.tick_ns)
            learner.catch_up()
        clock.sleep_until_ns(at_ns)
        files.see(index + 1)
        send(batch)
        if life is not None and index == life.at:
            replay = learner.keeper._replay
            assert replay is not None and replay._store is not None
            arm(life, replay._store._marks)
        learner.catch_up()
        learner.keeper.flush()
        for received in policies.drain():
            files.publish(received.message)
        if life is not None and index == life.at + WITHIN:
            die()
    learner.close()


def main(run: Path, arrivals: Path, lives: str) -> list[int]:
    """All lives; returns what each ended with, as `os.waitpid` says it."""
    plan: list[Life | None] = [*msgspec.json.decode(lives, type=list[Life]), None]
    recorded = msgspec.msgpack.decode(arrivals.read_bytes(), type=Arrivals)
    ends: list[int] = []
    for life in plan:
        child = os.fork()
        if child == 0:
            try:
                live(RunDir.open(run), recorded, life)
                os._exit(0)
            finally:  # with a traceback, and no further life
                sys.excepthook(*sys.exc_info())
                os._exit(1)
        ends.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        if ends[-1] == 1:
            break
    return ends


if __name__ == "__main__":
    sys.stdout.write(json.dumps(main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])))
