from __future__ import annotations

from rtcore import ordering
from rtcore.ordering import SourceOrder


def test_a_source_seen_from_its_start_is_passed_on_at_once() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert [order.live("a", number, f"a{number}") for number in (0, 1, 2)] == [None, None, None]
    assert out == ["a0", "a1", "a2"]


def test_a_source_met_in_mid_stream_waits_for_what_came_before() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert order.live("a", 3, "a3") == (0, 2)
    assert order.live("a", 4, "a4") is None
    for number in (1, 0, 2):
        order.history("a", number, f"a{number}")
    assert out == []
    order.fetched("a")
    assert out == ["a0", "a1", "a2", "a3", "a4"]
    assert order.live("a", 5, "a5") is None
    assert out[-1] == "a5"


def test_a_gap_is_asked_for_once_and_then_passed_over() -> None:
    out: list[int] = []
    order = SourceOrder(out.append)
    order.live("a", 0, 0)
    assert order.live("a", 4, 4) == (1, 3)
    assert order.live("a", 5, 5) is None
    order.history("a", 2, 2)
    assert out == [0]
    order.fetched("a")
    assert out == [0, 2, 4, 5]
    assert order.live("a", 3, 3) is None  # too late
    assert order.live("a", 6, 6) is None
    assert out == [0, 2, 4, 5, 6]


def test_a_fetch_that_brings_nothing_holds_nothing_up() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert order.live("a", 2500, "a2500") == (0, 2499)  # which the cache has lost
    order.fetched("a")
    assert order.live("a", 2501, "a2501") is None
    order.fetched("a")  # a second end changes nothing
    order.history("a", 7, "a7")  # too late
    assert out == ["a2500", "a2501"]


def test_repeats_are_dropped() -> None:
    out: list[int] = []
    order = SourceOrder(out.append)
    for number in (0, 1, 1, 0, 2, 1, 3):
        assert order.live("a", number, number) is None
    assert out == [0, 1, 2, 3]
    order.live("a", 5, 5)
    order.history("a", 2, 2)
    order.fetched("a")
    assert out == [0, 1, 2, 3, 5]


def test_sources_do_not_hold_each_other_up() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert order.live("a", 9, "a9") == (0, 8)
    assert order.live("b", 0, "b0") is None
    assert out == ["b0"]


def test_no_more_than_the_limit_is_held() -> None:
    out: list[int] = []
    order = SourceOrder(out.append)
    first = 10
    for number in range(first, first + ordering.HELD_LIMIT - 1):
        order.live("a", number, number)
    assert out == []
    order.live("a", first + ordering.HELD_LIMIT - 1, first + ordering.HELD_LIMIT - 1)
    assert out == list(range(first, first + ordering.HELD_LIMIT))
