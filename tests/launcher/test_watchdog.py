"""Who is killed for its silence: by what the kernel tells of its threads, scripted here."""

from __future__ import annotations

import pytest

from launcher import run_delay
from launcher.run_delay import Thread
from launcher.vitals import Vitals
from launcher.watchdog import Watchdog
from rtcore.channels import AGENT, LEARNER
from tests.launcher.ledgers import ledger

SECOND = 1_000_000_000
LOOK = SECOND // 20
PIDS = {AGENT: 1, LEARNER: 2}


class Machine:
    """A watchdog with a limit of 2 s over an agent and a learner, of which only the agent is heard."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(run_delay, "read", self.read)
        self.now_ns = 1000 * SECOND
        self.threads = {"2": Thread(0, 0, runnable=False), "3": Thread(0, 0, runnable=False)}
        self.asked: list[int] = []
        self.vitals = Vitals(2.0)
        self.watchdog = Watchdog(self.vitals, PIDS.__getitem__)
        for process in PIDS:
            self.vitals.started(process)
        self.look(0.05, AGENT, LEARNER)
        self.look(0.05, AGENT, LEARNER)

    def read(self, pid: int) -> dict[str, Thread]:
        self.asked.append(pid)
        return dict(self.threads)

    def wait(self, thread: str, ns: int) -> None:
        """A thread of the learner's waits for so long and runs a little."""
        before = self.threads[thread]
        self.threads[thread] = Thread(before.ran_ns + 1, before.waited_ns + ns, before.runnable)

    def look(self, seconds: float, *beating: str, waits: str = "") -> list[str]:
        """Looks, 20 a second; who hangs at the last one. `waits`: a thread that waits 90 % of the time."""
        found: list[str] = []
        for _ in range(round(seconds * 20)):
            self.now_ns += LOOK
            for process in beating:
                self.vitals.heard(ledger(process, beat_ns=self.now_ns), self.now_ns)
            if waits:
                self.wait(waits, LOOK * 9 // 10)
            found = self.watchdog.hung(self.now_ns)
        return found


def test_who_sleeps_in_a_silence_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch)
    assert machine.look(1.95, AGENT) == []
    assert machine.look(0.05, AGENT) == [LEARNER]
    assert machine.watchdog.starving() == []


@pytest.mark.parametrize("thread", ["2", "3"])  # the loop's, and the one by which it speaks
def test_who_waits_for_a_core_is_left_alone(thread: str, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch)
    assert machine.look(5.0, AGENT, waits=thread) == []
    assert machine.watchdog.starving() == [LEARNER]
    # After k looks it has been silent for k + 1; from the 20th on there is something to compare with. So 21
    # looks count in full and a tenth of each of the other 80: 29. The limit is 40.
    assert machine.look(0.55, AGENT) == []
    assert machine.look(0.05, AGENT) == [LEARNER]


def test_nothing_is_asked_of_the_system_while_all_speak(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch)
    machine.look(5.0, AGENT, LEARNER)
    assert machine.asked == []
    machine.look(1.1, AGENT)
    assert set(machine.asked) == {PIDS[LEARNER]}


def test_a_wait_of_an_earlier_silence_excuses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch)
    machine.look(1.5, AGENT)
    machine.look(0.05, AGENT, LEARNER)
    machine.wait("2", 100 * SECOND)
    assert machine.look(1.95, AGENT) == []
    assert machine.look(0.05, AGENT) == [LEARNER]
