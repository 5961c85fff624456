"""How long after its start does an agent that was killed act on the newest policy?

    python -m benchmarks.agent_restart --restarts 20

The env server ticks all the time; the agent is killed (SIGKILL) and started again, over and over. Counted is
from right before the system is asked for the new process until its first answer on a policy has reached the
env server, as the env server's log has it. Before each kill a newer policy is published, and an answer of
the new life that goes by an older one is counted.

`alive`: a learner publishes on the bus and has its file on this host. `dead`: there is the file alone.
`remote`: there is a learner, its file is on another host, and the agent has its own copy.
`bus`: there is a learner and no file at all. Here this process stands in for the learner.

With `--spare` every other life is that of a spare, which has waited loaded, as under `tenuto run`; counted is
from right before it gets its order. So both kinds of lives have the same machine in the same minutes.

Without a spare most of the time goes into loading; without a bytecode cache (PYTHONDONTWRITEBYTECODE) it
takes 0.1 s more.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import tyro

from benchmarks.harness import BenchmarkError, random_policy, world, write_result
from launcher.children import Children
from launcher.starting import spare_command
from launcher.stealing import StealMeter
from launcher.supervisor import command_for
from rtcore import channels
from rtcore.bus import Bus, QueueReader
from rtcore.files import write_atomic
from rtcore.messages import Policy, Step, StepBatch
from rtcore.monotonic import MonotonicClock
from rtcore.realtime import Rt
from rtcore.run_dir import RunDir
from rtcore.zenoh_bus import open_bus

Arm = Literal["alive", "dead", "remote", "bus"]
ARMS: tuple[Arm, ...] = ("alive", "dead", "remote", "bus")
LIMIT_S = 10.0
SETTLE_S = 0.4  # between two acts: published and adopted, killed and noticed
LIVED_S = 0.3  # of the new life's answers are looked at
LOADED_S = 1.5  # after its start a spare has loaded everything
AHEAD = ("chrt", "--rr", "1")
PACKAGES = ("eclipse-zenoh", "numpy")


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    restarts: int = 20  # of each arm
    arms: tuple[Arm, ...] = ARMS
    world: str = "halfcheetah"
    hz: float = 200.0
    hidden: tuple[int, ...] = (256, 256)
    rt: Rt = "auto"
    spare: bool = False  # every other life is a spare's
    ahead: bool = False  # the agent loads ahead of what else the machine does (SCHED_RR 1, by `chrt`)
    out: Path = Path("benchmarks/results")


@dataclass(frozen=True)
class Answer:
    """The agent's, as the env server logged it: when it arrived, and the policy behind it."""

    arrived_ns: int
    version: int


class Answers:
    """Reads the env server's log for answers in time."""

    def __init__(self, log: QueueReader[StepBatch]) -> None:
        self.skipped = 0  # deadlines that the env server lost, in what was read
        self._log = log
        self._sent_ns: dict[int, int] = {}

    def read(self, timeout_s: float) -> list[Answer]:
        """What was logged since; waits for it."""
        self._log.wait(timeout_s)
        steps = [step for received in self._log.drain() for step in received.message.steps]
        return [answer for step in steps if (answer := self._of(step)) is not None]

    def _of(self, step: Step) -> Answer | None:
        asked_ns = self._sent_ns.get(step.answered_tick)
        self._sent_ns[step.tick] = step.sent_ns
        self.skipped += step.skipped
        if step.missed or step.loop_ns < 0 or asked_ns is None:
            return None
        return Answer(asked_ns + step.loop_ns, step.policy_version)


class Stage:
    """An env server that ticks, an agent to kill, and this process as the learner, or a mere witness."""

    def __init__(self, arm: Arm, run_dir: RunDir, bus: Bus, first: Policy, children: Children) -> None:
        self._arm, self._run_dir, self._policy, self._children = arm, run_dir, first, children
        self._clock = MonotonicClock()
        self._answers = Answers(bus.queue(channels.LOG, "*"))
        self._policies = None if arm == "dead" else bus.publisher(channels.POLICY)

    def restart(self, *, spare: bool = False) -> dict[str, Any]:
        """Publish, kill, start, and wait for the first answers."""
        if spare:
            self._children.tend(math.inf)
            time.sleep(LOADED_S)
        self._publish()
        time.sleep(SETTLE_S)
        self._children.kill(self._children.running())
        if self._arm == "bus":
            self._run_dir.adopted_path(channels.AGENT).unlink(missing_ok=True)
        time.sleep(SETTLE_S)
        self._answers.read(0.1)
        skipped, self._answers.skipped = self._answers.skipped, 0
        began_ns = self._clock.now_ns()
        if self._children.start(channels.AGENT) != spare:
            raise BenchmarkError(f"{self._arm}: the spare did not live")
        answers = self._first_answers(began_ns)
        on_policy = [one for one in answers if one.version == self._policy.version]
        return {
            "spare": spare,
            "load_1min": os.getloadavg()[0],
            "first_ms": (answers[0].arrived_ns - began_ns) / 1e6,
            "newest_ms": (on_policy[0].arrived_ns - began_ns) / 1e6,
            "older_answers": len(answers) - len(on_policy),
            "skipped": self._answers.skipped,
            "skipped_before": skipped,  # in the 1.2 s without a start, for comparison; 2.7 s with a spare's
        }

    def _publish(self) -> None:
        self._policy = msgspec.structs.replace(
            self._policy, version=self._policy.version + 1, created_ns=self._clock.now_ns()
        )
        if self._arm in ("alive", "dead"):
            write_atomic(self._run_dir.policy_path, msgspec.msgpack.encode(self._policy))
        if self._policies is not None:
            self._policies.put(self._policy)

    def _first_answers(self, began_ns: int) -> list[Answer]:
        found: list[Answer] = []
        limit_ns = began_ns + round(LIMIT_S * 1e9)
        while not any(one.version == self._policy.version for one in found):
            if self._clock.now_ns() > limit_ns:
                raise BenchmarkError(f"{self._arm}: no answer on policy {self._policy.version}")
            found += [one for one in self._answers.read(0.1) if one.arrived_ns > began_ns]
        newest_ns = next(one.arrived_ns for one in found if one.version == self._policy.version)
        while self._clock.now_ns() < newest_ns + round(LIVED_S * 1e9):
            found += [one for one in self._answers.read(0.1) if one.arrived_ns > began_ns]
        return found


@contextmanager
def staged(arguments: Arguments, arm: Arm) -> Iterator[Stage]:
    """The stage of one arm."""
    config = world(arguments.world, hz=arguments.hz, seconds=0, rt=arguments.rt)
    config = replace(config, env=replace(config.env, start_wait_s=0.0))
    with ExitStack() as stack:
        directory = stack.enter_context(tempfile.TemporaryDirectory(prefix="tenuto-"))
        run_dir = RunDir.create(Path(directory) / "run", config)
        stack.callback(run_dir.remove_socket_dir)
        role = "client" if arm == "dead" else channels.LEARNER
        bus = open_bus(role, run_dir.run_name, run_dir.socket_dir(), clock=MonotonicClock())
        stack.enter_context(bus)
        env_server = subprocess.Popen(command_for(channels.ENV_SERVER, run_dir.path))
        stack.callback(env_server.wait)
        stack.callback(env_server.terminate)
        command = command_for(channels.AGENT, run_dir.path)
        children = Children(
            {channels.AGENT: [*(AHEAD if arguments.ahead else ()), *command]},
            run_dir.logs_dir,
            {channels.AGENT: spare_command(command)},
        )
        stack.enter_context(children.kept())
        yield Stage(arm, run_dir, bus, random_policy(config, arguments.hidden), children)


def measure(arguments: Arguments, arm: Arm) -> list[dict[str, Any]]:
    """All restarts of one arm, and their quantiles in ms; of each kind of life apart."""
    steal = StealMeter()
    kinds = (False, True) if arguments.spare else (False,)
    with staged(arguments, arm) as stage:
        stage.restart()  # the first start of all reads the program from the disk
        rows = [stage.restart(spare=kind) for _ in range(arguments.restarts) for kind in kinds]
    stolen_s = steal.elapsed_s()  # in all of them
    return [
        {"arm": arm, "spare": kind, "stolen_s": stolen_s}
        | quantiles([row for row in rows if row["spare"] == kind])
        for kind in kinds
    ]


def quantiles(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What the restarts of one kind come to."""
    newest = np.array([row["newest_ms"] for row in rows])
    return {
        "p50_ms": float(np.quantile(newest, 0.5)),
        "p90_ms": float(np.quantile(newest, 0.9)),
        "max_ms": float(newest.max()),
        "within_300_ms": int((newest <= 300).sum()),
        "restarts": len(rows),
        "older_answers": sum(row["older_answers"] for row in rows),
        "skipped": sum(row["skipped"] for row in rows),
        "rows": rows,
    }


def main(arguments: Arguments) -> None:
    """Measure, print a table, write the result."""
    if arguments.spare and arguments.ahead:
        raise BenchmarkError("--spare and --ahead: nobody can be started ahead who runs already")
    print(
        f"{'arm':>14}{'p50':>9}{'p90':>9}{'max':>9} ms{'<= 300 ms':>12}{'on an older one':>17}{'skipped':>9}"
    )
    found = []
    for arm in arguments.arms:
        for one in measure(arguments, arm):
            found.append(one)
            share = f"{one['within_300_ms']}/{one['restarts']}"
            name = arm + " spare" * one["spare"]
            print(
                f"{name:>14}{one['p50_ms']:9.0f}{one['p90_ms']:9.0f}{one['max_ms']:9.0f}{share:>15}"
                f"{one['older_answers']:>15}{one['skipped']:>9}",
                flush=True,
            )
    write_result(
        "agent_restart-spare" if arguments.spare else "agent_restart",
        arguments,
        PACKAGES,
        {"bytecode": not sys.dont_write_bytecode, "arms": found},
    )


if __name__ == "__main__":
    main(tyro.cli(Arguments))
