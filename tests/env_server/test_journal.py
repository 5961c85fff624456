from __future__ import annotations

import threading
from collections.abc import Callable

from env_server.journal import Journal
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Step, StepBatch

MS = 1_000_000


def step(seq: int) -> Step:
    return Step(
        env="env0", incarnation=1, seq=seq, tick=seq, episode=0, episode_tick=seq, unit=0, due_ns=0,
        woke_ns=0, sent_ns=0, observation=b"", reward=0.0, terminated=False, truncated=False, action=b"",
        decision=b"", answered_tick=-1, policy_version=-1, missed=False, fallback="", cause="", skipped=0,
        loop_ns=-1, reaction_ns=-1, drift=0.0, position=b"",
    )  # fmt: skip


class Wire:
    """A publisher that keeps what it is given, and fails or blocks when told to."""

    def __init__(self, before: Callable[[], None] = lambda: None) -> None:
        self.sent: list[StepBatch] = []
        self.before = before

    def put(self, message: StepBatch) -> None:
        self.before()
        self.sent.append(message)

    def shape(self) -> list[tuple[int, bool]]:
        return [(len(batch.steps), batch.last) for batch in self.sent]

    def seqs(self) -> list[int]:
        return [step.seq for batch in self.sent for step in batch.steps]


def make(wire: Wire, capacity: int = 1000) -> tuple[Journal, Ledger]:
    ledger = Ledger("env_server", 1)
    return Journal(wire, VirtualClock(), ledger, capacity_steps=capacity), ledger


def fill(journal: Journal, begin: int, end: int) -> None:
    for seq in range(begin, end):
        journal.append(step(seq))


def test_batches_hold_fifty_steps_at_most_in_order() -> None:
    wire = Wire()
    journal, _ = make(wire)
    fill(journal, 0, 120)
    assert journal.flush() == 120
    assert wire.shape() == [(50, False), (50, False), (20, False)]
    assert wire.seqs() == list(range(120))
    assert journal.flush() == 0
    assert len(wire.sent) == 3


def test_close_says_that_nothing_follows_once() -> None:
    wire = Wire()
    journal, _ = make(wire)
    fill(journal, 0, 70)
    journal.close()
    journal.close()
    assert wire.shape() == [(50, False), (20, True)]


def test_close_says_so_even_when_nothing_waits() -> None:
    wire = Wire()
    journal, _ = make(wire)
    fill(journal, 0, 50)
    journal.flush()
    journal.close()
    assert wire.shape() == [(50, False), (0, True)]


def test_a_full_last_batch_is_the_last() -> None:
    wire = Wire()
    journal, _ = make(wire)
    fill(journal, 0, 50)
    journal.close()
    assert wire.shape() == [(50, True)]


def test_flush_is_due_after_fifty_steps_or_fifty_milliseconds() -> None:
    wire, clock = Wire(), VirtualClock()
    journal = Journal(wire, clock, Ledger("env_server", 1))

    def due() -> bool:
        return journal.flush_due(clock.now_ns())

    fill(journal, 0, 49)
    assert not due()
    fill(journal, 49, 50)
    assert due()
    fill(journal, 50, 51)
    clock.advance_ns(50 * MS - 1)
    assert not due()
    clock.advance_ns(1)
    assert due()
    assert wire.seqs() == list(range(51))


def test_a_full_journal_drops_the_oldest_and_counts_them() -> None:
    wire = Wire()
    journal, ledger = make(wire, capacity=100)
    fill(journal, 0, 130)
    journal.flush()
    assert wire.seqs() == list(range(30, 130))
    assert ledger.counter("log.dropped") == 30


def test_a_failed_put_loses_nothing_and_does_not_end_the_loop() -> None:
    failures = iter([False, True, True, False, False])
    stop = Stop()

    def before() -> None:
        if next(failures):
            raise RuntimeError("the link is down")
        if len(wire.sent) == 2:
            stop.set("all sent")

    wire = Wire(before)
    journal, ledger = make(wire)
    fill(journal, 0, 120)
    journal.run(stop)
    assert wire.seqs() == list(range(120))
    assert ledger.counter("log.errors") == 2


def test_a_blocked_put_blocks_neither_the_loop_nor_the_end() -> None:
    entered, release = threading.Event(), threading.Event()

    def before() -> None:
        entered.set()
        assert release.wait(10)

    wire = Wire(before)
    journal, ledger = make(wire)
    fill(journal, 0, 3)
    thread = threading.Thread(target=journal.flush)
    thread.start()
    assert entered.wait(10)
    fill(journal, 3, 10)  # returns at once, or this test hangs
    journal.close(timeout_s=0.01)
    assert ledger.counter("log.dropped") == 7
    release.set()
    thread.join()


def test_over_a_bus_a_late_reader_gets_everything() -> None:
    clock = VirtualClock()
    hub = MemoryHub()
    journal = Journal(hub.bus("env", clock).publisher(channels.LOG, "env0"), clock, Ledger("env_server", 1))
    fill(journal, 0, 60)
    journal.close()
    batches = [received.message for received in hub.bus("late", clock).queue(channels.LOG, "*").drain()]
    assert [(len(batch.steps), batch.last) for batch in batches] == [(50, False), (10, True)]
    assert batches[1].steps[-1] == step(59)
