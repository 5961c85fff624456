from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest

from launcher import supervisor
from launcher.restarts import Happening, Restarts
from launcher.supervisor import End, Interrupts, OrderlyEnd, Supervisor
from launcher.vitals import Vitals
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER

CHILD = Path(__file__).with_name("children.py")
TERM, KILL = signal.SIGTERM, signal.SIGKILL


def children(directory: Path, behaviours: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Command lines of four fake processes, obedient unless said otherwise."""
    return {
        name: [sys.executable, str(CHILD), name, str(directory), *behaviours.get(name, ["obedient"])]
        for name in PROCESSES
    }


def supervise(
    directory: Path,
    behaviours: Mapping[str, Sequence[str]],
    act: Callable[[Interrupts], None],
    restarts: Restarts | None = None,
    vitals: Vitals | None = None,
    tell: Callable[[Happening], None] = lambda happening: None,
) -> End:
    """Supervise four fakes; `act` is called once, when all of them are ready."""
    fakes = Supervisor(
        children(directory, behaviours), directory, restarts=restarts, vitals=vitals, tell=tell
    )
    interrupts = Interrupts()
    acted = False

    def poll(waiting_for: frozenset[str]) -> None:
        nonlocal acted
        if not acted and len(list(directory.glob("*.ready"))) == len(PROCESSES):
            acted = True
            act(interrupts)

    with fakes.started():
        return fakes.supervise(interrupts, poll)


def once(interrupts: Interrupts) -> None:
    interrupts.count += 1


def twice(interrupts: Interrupts) -> None:
    interrupts.count += 2


def never(interrupts: Interrupts) -> None:
    pass


def ended(directory: Path) -> list[str]:
    return (directory / "ended").read_text().split()


def test_an_interrupt_ends_all_in_order(tmp_path: Path) -> None:
    end = supervise(tmp_path, {}, once)
    assert end == End("interrupted")
    assert ended(tmp_path) == [ENV_SERVER, AGENT, LEARNER, RECORDER]


def test_the_env_servers_own_end_is_the_normal_one(tmp_path: Path) -> None:
    end = supervise(tmp_path, {ENV_SERVER: ["ends", "0"]}, never)
    assert end == End("duration")
    assert ended(tmp_path) == [ENV_SERVER, AGENT, LEARNER, RECORDER]


@pytest.mark.parametrize(("process", "code"), [(LEARNER, 3), (AGENT, 0), (ENV_SERVER, 2)])
def test_without_restarts_any_other_death_ends_the_run_loudly(
    process: str, code: int, tmp_path: Path
) -> None:
    end = supervise(tmp_path, {process: ["ends", str(code)]}, never)
    assert end.reason == "failed"
    (failure,) = end.failures
    assert (failure.process, failure.code, failure.output) == (process, code, f"{process}: no more")
    assert str(failure) == f"{process} ended unexpectedly (exit code {code})"
    rest = [name for name in PROCESSES if name != process]
    assert ended(tmp_path) == [process, *rest]


def test_without_restarts_a_process_killed_from_outside_is_a_failure(tmp_path: Path) -> None:
    def murder(interrupts: Interrupts) -> None:
        os.kill(int((tmp_path / f"{RECORDER}.ready").read_text()), KILL)

    end = supervise(tmp_path, {}, murder)
    assert [str(failure) for failure in end.failures] == ["recorder ended unexpectedly (signal SIGKILL)"]
    assert ended(tmp_path) == [ENV_SERVER, AGENT, LEARNER]


def test_who_does_not_end_is_killed_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "INTERRUPTED_LIMIT_S", 0.6)
    end = supervise(tmp_path, {AGENT: ["stubborn"]}, once)
    assert end == End("interrupted", [], [AGENT])
    assert ended(tmp_path) == [ENV_SERVER, LEARNER, RECORDER]


def test_a_second_interrupt_kills_at_once(tmp_path: Path) -> None:
    began = time.monotonic()
    end = supervise(tmp_path, {name: ["stubborn"] for name in PROCESSES}, twice)
    assert end.reason == "killed"
    assert time.monotonic() - began < supervisor.INTERRUPTED_LIMIT_S
    assert not (tmp_path / "ended").exists()


def test_signals_reach_the_launcher_alone_and_twice_kills(tmp_path: Path) -> None:
    root = CHILD.parents[2]
    launcher = subprocess.Popen(
        [sys.executable, "-m", "tests.launcher.supervised", str(tmp_path)], cwd=root, start_new_session=True
    )
    wait_for(lambda: len(list(tmp_path.glob("*.ready"))) == len(PROCESSES))
    os.killpg(launcher.pid, signal.SIGINT)  # as the terminal sends Ctrl-C to its foreground group
    wait_for(lambda: (tmp_path / "ended").exists() and ended(tmp_path) == [ENV_SERVER, AGENT])
    assert launcher.poll() is None  # the learner is stubborn
    os.killpg(launcher.pid, signal.SIGINT)
    assert launcher.wait(timeout=5) == 130
    for name in PROCESSES:
        pid = int((tmp_path / f"{name}.ready").read_text())
        assert not Path(f"/proc/{pid}").exists()


def wait_for(condition: Callable[[], bool], limit_s: float = 10.0) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, "never came"
        time.sleep(0.01)


def test_the_order_in_time() -> None:
    plan = OrderlyEnd(PROCESSES, begin_s=100.0, limit_s=10.0)
    everybody = frozenset(PROCESSES)
    assert plan.due(100.0, everybody) == [(ENV_SERVER, TERM)]
    assert plan.due(101.9, everybody) == []
    assert plan.due(102.0, everybody) == [(AGENT, TERM)]  # its turn, though the env server still runs
    assert plan.due(102.1, frozenset({LEARNER, RECORDER})) == [(LEARNER, TERM)]
    assert plan.due(106.9, frozenset({LEARNER, RECORDER})) == []
    assert plan.due(107.0, frozenset({LEARNER, RECORDER})) == [(RECORDER, TERM)]
    assert plan.due(109.9, frozenset({LEARNER})) == []
    assert plan.due(110.0, frozenset({LEARNER})) == [(LEARNER, KILL)]


def test_hurry_only_shortens() -> None:
    plan = OrderlyEnd(PROCESSES, begin_s=0.0, limit_s=10.0)
    plan.hurry(now_s=2.0, limit_s=4.0)
    assert plan.limit_s == 6.0
    plan.hurry(now_s=5.0, limit_s=4.0)
    assert plan.limit_s == 6.0
    assert plan.due(6.0, frozenset({RECORDER})) == [(RECORDER, KILL)]


def test_interrupts_are_counted_and_handlers_restored() -> None:
    before = signal.getsignal(signal.SIGTERM)
    interrupts = Interrupts()
    with interrupts.counted():
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGHUP)
        wait_for(lambda: interrupts.count == 2)
    assert signal.getsignal(signal.SIGTERM) is before
