"""What the agent can say for itself, with the clock in hand."""

from __future__ import annotations

import gc
import hashlib
import os
import threading
import time

from agent_service.evidence import RECENT_NS, Evidence, Excuse, Stopwatch
from rtcore.clock import VirtualClock


def test_a_stopwatch_counts_what_is_under_way_and_what_is_over() -> None:
    clock = VirtualClock(1_000)
    watch = Stopwatch(clock.now_ns)
    watch.stop()  # of what never began
    watch.start()
    clock.advance_ns(30)
    assert watch.read_ns(clock.now_ns()) == 30
    watch.stop()
    clock.advance_ns(500)
    assert watch.read_ns(clock.now_ns()) == 30
    watch.start()
    clock.advance_ns(7)
    watch.stop()
    assert watch.read_ns(clock.now_ns()) == 37


def test_an_excuse_is_about_the_time_since_the_one_before() -> None:
    clock = VirtualClock(1_000)
    evidence = Evidence(clock.now_ns, lambda: 900)
    assert evidence.excuse(950) == Excuse(resumed_ns=900, since_ns=950)
    evidence.swapping.start()
    clock.advance_ns(40)
    evidence.swapping.stop()
    evidence.checking.start()
    clock.advance_ns(2)
    assert evidence.excuse(1_010) == Excuse(swap_ns=42, resumed_ns=900, since_ns=950)
    clock.advance_ns(5)
    evidence.checking.stop()  # it went on beside the answer: the rest is the next one's
    assert evidence.excuse(1_045).swap_ns == 5
    assert evidence.excuse(1_046).swap_ns == 0


def test_a_rehearsal_leaves_the_excuse_to_the_next_answer() -> None:
    clock = VirtualClock(1_000)
    evidence = Evidence(clock.now_ns)
    evidence.swapping.start()
    clock.advance_ns(40)
    evidence.swapping.stop()
    assert evidence.excuse(1_000, settle=False).swap_ns == 40
    assert evidence.excuse(1_000).swap_ns == 40
    assert evidence.excuse(1_000).swap_ns == 0


def test_a_collection_is_an_excuse_while_evidence_is_gathered() -> None:
    evidence = Evidence(time.monotonic_ns)
    with evidence.gathered():
        evidence.excuse(1)
        begin_ns = time.monotonic_ns()
        gc.collect()
        took_ns = time.monotonic_ns() - begin_ns
        assert 0 < evidence.excuse(1).collector_ns <= took_ns
        assert evidence.excuse(1).collector_ns == 0
    gc.collect()
    assert evidence.excuse(1).collector_ns == 0


def burn(core: int, cpu_ns: int, together: threading.Barrier) -> None:
    """Compute for `cpu_ns` on `core`, once all are there, without the interpreter: hashing lets go of it."""
    os.sched_setaffinity(0, {core})
    together.wait(20.0)
    work, ballast = hashlib.sha256(), bytes(1 << 20)
    end_ns = time.thread_time_ns() + cpu_ns
    while time.thread_time_ns() < end_ns:
        work.update(ballast)


def test_a_wait_for_a_core_is_an_excuse_of_the_thread_that_waited() -> None:
    evidence, core = Evidence(time.monotonic_ns), max(os.sched_getaffinity(0))
    starved_ns: list[int] = []

    def act() -> None:
        together = threading.Barrier(4)
        rivals = [threading.Thread(target=burn, args=(core, 20_000_000, together)) for _ in range(3)]
        for rival in rivals:
            rival.start()
        evidence.excuse(1)
        began_ns = time.monotonic_ns()
        burn(core, 8_000_000, together)
        waits = [evidence.excuse(1).starved_ns, evidence.excuse(1).starved_ns]
        if time.monotonic_ns() - began_ns < RECENT_NS:
            starved_ns.extend(waits)
        for rival in rivals:
            rival.join()

    with evidence.gathered():
        for _ in range(50):  # on a core that others load as well, a wait may be too long to be an excuse
            acting = threading.Thread(target=act)
            acting.start()
            acting.join()
            if starved_ns:
                break
    # four threads share the core: 8 ms of work take 32, and 24 of these are waiting
    assert starved_ns[0] > 5_000_000
    assert starved_ns[1] < starved_ns[0] / 2
