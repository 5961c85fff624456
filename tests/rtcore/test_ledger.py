"""The ledger: cumulative, bounded, and exact under threads."""

from __future__ import annotations

import logging
import sys
import threading

import msgspec
import pytest

from rtcore import channels
from rtcore.histogram import Histogram
from rtcore.ledger import MAX_EVENTS, MAX_TEXT, RECENT_RETURNS, RECENT_WINDOWS, REPEAT_NS, Ledger
from rtcore.messages import EpisodeReturn, Stats, WindowNotice


def episode(number: int) -> EpisodeReturn:
    return EpisodeReturn(episode=number, at_ns=number * 10, value=-1.5 * number, length=200)


def notice(number: int) -> WindowNotice:
    return WindowNotice(
        window=number, start_unit=number, update_units=1, hold_units=0, phase="update", at_ns=number
    )


def test_an_empty_ledger() -> None:
    stats = Ledger("learner", 77).stats(123)
    assert stats == Stats(
        process="learner",
        incarnation=77,
        seq=0,
        at_ns=123,
        final=False,
        counters={},
        gauges={},
        histograms={},
        events=[],
        returns=[],
        windows=[],
    )


def test_counters_are_cumulative_and_start_at_zero() -> None:
    ledger = Ledger("env_server", 1)
    ledger.count("ticks")
    ledger.count("ticks", 4)
    ledger.count("missed", 0)
    assert (ledger.counter("ticks"), ledger.counter("never")) == (5, 0)
    assert ledger.stats(1).counters == {"ticks": 5, "missed": 0}
    ledger.count("ticks")
    assert ledger.stats(2).counters == {"ticks": 6, "missed": 0}


def test_counters_do_not_fall() -> None:
    ledger = Ledger("env_server", 1)
    ledger.set_counter("messages.rejected", 3)
    ledger.set_counter("messages.rejected", 3)
    with pytest.raises(ValueError, match=r"messages.rejected: 2 after 3"):
        ledger.set_counter("messages.rejected", 2)
    with pytest.raises(ValueError, match="ticks: n = -1"):
        ledger.count("ticks", -1)
    assert ledger.stats(1).counters == {"messages.rejected": 3}


def test_a_group_adds_and_takes_over_and_none_of_it_falls() -> None:
    ledger = Ledger("agent_service", 1)
    ledger.count("never", 0)
    ledger.count_together("received", values={"first": 4, "newest": 4})
    ledger.count_together("received", values={"first": 4, "newest": 6})
    with pytest.raises(ValueError, match=r"newest: 5 after 6"):
        ledger.count_together("received", values={"newest": 5})
    assert ledger.stats(1).counters == {"never": 0, "received": 2, "first": 4, "newest": 6}


def test_gauges_keep_the_newest_value() -> None:
    ledger = Ledger("learner", 1)
    ledger.gauge("alpha", 0.2)
    ledger.gauge("alpha", 0.1)
    assert ledger.stats(1).gauges == {"alpha": 0.1}


def test_a_histogram_is_made_once_and_travels_whole() -> None:
    ledger = Ledger("agent_service", 1)
    reaction = ledger.histogram("reaction")
    assert ledger.histogram("reaction") is reaction
    reaction.record(100)
    ledger.stats(1)
    reaction.record(300)
    received = Histogram.from_bytes(ledger.stats(2).histograms["reaction"])
    assert (received.count, received.sum, received.max) == (2, 400, 300)


def test_events_are_repeated_for_ten_seconds_and_given_at_least_once() -> None:
    ledger = Ledger("agent_service", 1)
    ledger.event(5, "INFO", "early")
    assert [event.text for event in ledger.stats(6).events] == ["early"]
    ledger.event(REPEAT_NS, "INFO", "late")
    assert [event.text for event in ledger.stats(REPEAT_NS + 5).events] == ["early", "late"]
    assert [event.text for event in ledger.stats(REPEAT_NS + 6).events] == ["late"]
    ledger.event(REPEAT_NS, "INFO", "told late")
    assert [event.text for event in ledger.stats(3 * REPEAT_NS).events] == ["told late"]
    assert ledger.stats(3 * REPEAT_NS).events == []


def test_events_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    ledger = Ledger("agent_service", 1)
    with caplog.at_level(logging.DEBUG):
        ledger.event(5, "WARN", "policy 3 refused: 100% wrong")
        ledger.event(6, "ERROR", "gone")
    assert [(event.at_ns, event.level, event.text) for event in ledger.stats(7).events] == [
        (5, "WARN", "policy 3 refused: 100% wrong"),
        (6, "ERROR", "gone"),
    ]
    assert [(record.name, record.levelname, record.getMessage()) for record in caplog.records] == [
        ("agent_service", "WARNING", "policy 3 refused: 100% wrong"),
        ("agent_service", "ERROR", "gone"),
    ]


def test_a_flood_of_events_drops_the_oldest_and_counts_them() -> None:
    ledger = Ledger("learner", 1)
    for number in range(MAX_EVENTS + 3):
        ledger.event(number, "DEBUG", f"{number}")
    stats = ledger.stats(1)
    assert [event.at_ns for event in stats.events] == list(range(3, MAX_EVENTS + 3))
    assert stats.counters == {"events.dropped": 3}
    ledger.event(999, "DEBUG", "one more")
    assert ledger.stats(2).counters == {"events.dropped": 3}


def test_returns_are_the_newest_and_at_the_end_all() -> None:
    ledger = Ledger("env_server", 1)
    ledger.episode(episode(0))
    assert ledger.stats(1).returns == [episode(0)]
    for number in range(1, RECENT_RETURNS + 6):
        ledger.episode(episode(number))
    assert ledger.stats(2).returns == [episode(number) for number in range(6, RECENT_RETURNS + 6)]
    final = ledger.stats(3, final=True)
    assert final.final
    assert final.returns == [episode(number) for number in range(RECENT_RETURNS + 6)]


def test_windows_are_replaced_and_copied() -> None:
    ledger = Ledger("learner", 1)
    windows = [notice(0)]
    ledger.windows(windows)
    windows.append(notice(1))
    assert ledger.stats(1).windows == [notice(0)]
    ledger.windows([notice(number) for number in range(RECENT_WINDOWS + 2)])
    assert ledger.stats(2).windows[0] == notice(2)
    assert len(ledger.stats(3, final=True).windows) == RECENT_WINDOWS + 2


def test_a_snapshot_survives_the_wire_and_later_counting() -> None:
    ledger = Ledger("recorder", 9)
    ledger.count("rows", 2)
    ledger.histogram("loop").record(5)
    ledger.event(1, "INFO", "hello")
    first, second = ledger.stats(10), ledger.stats(20)
    ledger.count("rows")
    assert (first.seq, second.seq, first.counters) == (0, 1, {"rows": 2})
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(first), type=Stats) == first


def test_the_fullest_running_message_fits_the_channel() -> None:
    ledger = Ledger("learner", 2**62)
    for _ in range(MAX_EVENTS + 1):
        ledger.event(2**62, "DEBUG", "x" * (MAX_TEXT + 50))
    ledger.windows([notice(2**40 + number) for number in range(RECENT_WINDOWS + 1)])
    stats = ledger.stats(2**62)
    assert len(stats.events[0].text) == MAX_TEXT
    assert len(msgspec.msgpack.encode(stats)) < channels.STATS.max_bytes // 2


def test_counting_from_threads_loses_nothing() -> None:
    ledger = Ledger("learner", 1)

    def work() -> None:
        for _ in range(5_000):
            ledger.count("received")

    threads = [threading.Thread(target=work) for _ in range(4)]
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads interrupt each other as often as they can
    try:
        for thread in threads:
            thread.start()
        snapshots = [ledger.stats(number).counters.get("received", 0) for number in range(50)]
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval_s)
    assert ledger.counter("received") == 20_000
    assert snapshots == sorted(snapshots)
