"""The services of compose.yaml without the containers: their own commands, checks and policy, here.

Only what a container would see differently is replaced: the interpreter, the mount, the router's address.
"""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from launcher.chaos.faults import Lives
from launcher.deploy import PORT, ROUTER, RUNS, Service, services
from recorder import reading
from rtcore.channels import AGENT, LEARNER, PROCESSES, RECORDER
from rtcore.run_dir import RunDir

pytestmark = pytest.mark.timeout(120)  # others are played beside it
RUN = ("bandit", "--env.hz", "50", "--duration-s", "0")  # a world whose learner is up in no time


@dataclass
class Engine:
    """Starts services as a container engine does, more or less."""

    runs: Path
    port: int
    found: dict[str, Service] = field(default_factory=lambda: {one.name: one for one in services(RUN)})
    running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def here(self, words: Sequence[str]) -> list[str]:
        """A container's command line, on this machine."""
        places = {
            str(RUNS): str(self.runs), f"tcp/{ROUTER}:{PORT}": f"tcp/127.0.0.1:{self.port}",
            f"tcp/0.0.0.0:{PORT}": f"tcp/127.0.0.1:{self.port}", f", {PORT})": f", {self.port})",
        }  # fmt: skip
        command = [sys.executable, *(["-m", "launcher"] if words[0] == "tenuto" else [])]
        for word in words[1:]:
            for there, here in places.items():
                word = word.replace(there, here)
            command.append(word)
        return command

    def start(self, name: str) -> None:
        with (self.runs / f"{name}.out").open("ab") as output:
            self.running[name] = subprocess.Popen(
                self.here(self.found[name].command), stdout=output, stderr=subprocess.STDOUT
            )

    def kill(self, name: str) -> None:
        self.running[name].kill()
        self.running[name].wait()

    def checks(self, *names: str) -> dict[str, int]:
        """The health of services, all asked at once."""
        asked = {
            name: subprocess.Popen(
                self.here(self.found[name].check), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            for name in names
        }
        return {name: check.wait(40) for name, check in asked.items()}

    def stop(self) -> dict[str, int]:
        """End all, who depends on others first; exit codes."""
        codes: dict[str, int] = {}
        while len(codes) < len(self.found):
            for name in self.found:
                depended = {
                    one for other in self.found if other not in codes for one in self.found[other].after
                }
                if name not in codes and name not in depended:
                    self.running[name].send_signal(signal.SIGTERM)
                    codes[name] = self.running[name].wait(20)
        return codes


@contextmanager
def up(runs: Path) -> Iterator[Engine]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        engine = Engine(runs, probe.getsockname()[1])
    with ExitStack() as ends:
        for name in engine.found:
            engine.start(name)
            ends.callback(engine.kill, name)
        yield engine


def play(runs: Path) -> dict[str, object]:
    """Up, healthy, the agent killed and started again by its policy, healthy, down."""
    with up(runs) as engine:
        deadline = time.monotonic() + 40
        log = runs / "live" / "logs" / "env_server.jsonl"
        while not (log.exists() and " Hz" in log.read_text()):
            assert time.monotonic() < deadline, [path.read_text() for path in runs.glob("*.out")]
            time.sleep(0.05)
        found = {name: Lives(runs / "live").pids(name) for name in PROCESSES}
        first = engine.checks(*engine.found)
        engine.running[AGENT].kill()
        killed = engine.running[AGENT].wait()
        engine.start(AGENT)
        second = engine.checks(AGENT)
        codes = engine.stop()
    return {
        "runs": runs, "pids": {name: one.pid for name, one in engine.running.items()}, "found": found,
        "first": first, "killed": killed, "second": second, "codes": codes,
    }  # fmt: skip


@pytest.fixture(scope="module")
def story(played: Callable[[str], Any]) -> dict[str, object]:
    found: dict[str, object] = played("test_compose")
    return found


def test_every_service_runs_and_is_healthy(story: dict[str, object]) -> None:
    assert story["first"] == dict.fromkeys((ROUTER, *PROCESSES), 0)


def test_each_command_becomes_the_process_that_the_launcher_starts(story: dict[str, object]) -> None:
    found, pids = story["found"], story["pids"]
    assert isinstance(found, dict) and isinstance(pids, dict)
    others = set(PROCESSES) - {AGENT}  # which has another number by now
    assert {name: found[name] for name in others} == {name: [pids[name]] for name in others}
    assert len(found[AGENT]) == 1


def test_who_dies_is_healthy_again_once_it_is_started_again(story: dict[str, object]) -> None:
    assert story["killed"] == -signal.SIGKILL  # not 0, and not 2: the policy starts it again
    assert story["second"] == {AGENT: 0}


def test_they_end_in_order_and_leave_a_whole_run(story: dict[str, object]) -> None:
    assert story["codes"] == dict.fromkeys((ROUTER, *PROCESSES), 0)
    assert isinstance(story["runs"], Path)
    run_dir = RunDir.open(story["runs"] / "live")
    stats = run_dir.read_final_stats()
    assert {one.process for one in stats if one.final} == set(PROCESSES)
    total = {(one.process, one.incarnation): one.counters for one in stats}
    ticks = next(counters["ticks"] for (name, _), counters in total.items() if name == "env_server")
    learned = next(counters["learned"] for (name, _), counters in total.items() if name == LEARNER)
    produced = next(counters["produced"] for (name, _), counters in total.items() if name == "env_server")
    rows, _ = reading.columns(run_dir.recording_path, "/env/reward")
    dropped = next(counters["dropped"] for (name, _), counters in total.items() if name == RECORDER)
    assert len(rows) == ticks - dropped
    assert learned == produced
