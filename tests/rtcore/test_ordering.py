from __future__ import annotations

from rtcore import ordering
from rtcore.ordering import SourceOrder


def test_a_source_seen_from_its_start_is_passed_on_at_once() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert [order.live("a", number, f"a{number}") for number in (0, 1, 2)] == [False, False, False]
    assert out == ["a0", "a1", "a2"]


def test_a_source_met_in_mid_stream_waits_for_what_came_before() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert order.live("a", 3, "a3")
    assert not order.live("a", 4, "a4")
    for number in (1, 0, 2):
        order.history("a", number, f"a{number}")
    assert out == []
    order.fetched("a")
    assert out == ["a0", "a1", "a2", "a3", "a4"]
    assert not order.live("a", 5, "a5")
    assert out[-1] == "a5"


def test_a_fetch_that_brings_nothing_holds_nothing_up() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert order.live("a", 2500, "a2500")  # the cache has lost 0 to 2499
    order.fetched("a")
    assert not order.live("a", 2501, "a2501")
    order.fetched("a")  # a second end changes nothing
    order.history("a", 7, "a7")  # too late
    assert out == ["a2500", "a2501"]


def test_repeats_are_dropped_and_gaps_are_passed_over() -> None:
    out: list[int] = []
    order = SourceOrder(out.append)
    for number in (0, 1, 1, 0, 5, 3, 6):
        order.live("a", number, number)
    assert out == [0, 1, 5, 6]


def test_sources_do_not_hold_each_other_up() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert order.live("a", 9, "a9")
    assert not order.live("b", 0, "b0")
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
