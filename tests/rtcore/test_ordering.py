from __future__ import annotations

from types import SimpleNamespace

import msgspec

from rtcore import lossless, ordering
from rtcore.channels import LOG
from rtcore.codec import Codec, Rejections, seal
from rtcore.inbox import QueueInbox, ThreadBell
from rtcore.ordering import SourceOrder
from tests.rtcore.bus_samples import batch


def test_a_source_seen_from_its_start_is_passed_on_at_once() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert [order.live("a", number, f"a{number}") for number in (0, 1, 2)] == [None, None, None]
    assert out == ["a0", "a1", "a2"]


def test_a_source_met_in_mid_stream_waits_for_what_came_before() -> None:
    out: list[str] = []
    order = SourceOrder(out.append)
    assert order.live("a", 3, "a3") == 0
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
    assert order.live("a", 4, 4) == 1
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
    assert order.live("a", 2500, "a2500") == 0  # which the cache has lost
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
    assert order.live("a", 9, "a9") == 0
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


class FakeSample:
    """Number `number` of publisher zid/7, as Zenoh hands it over."""

    key_expr = "env/env0/log"

    def __init__(self, number: int, payload: bytes | None = None, *, numbered: bool = True) -> None:
        self.payload = FakePayload(
            seal(msgspec.msgpack.encode(batch(number))) if payload is None else payload
        )
        source = SimpleNamespace(zid="zid", eid=7)
        self.source_info = SimpleNamespace(source_id=source, source_sn=number) if numbered else None


class FakePayload:
    def __init__(self, content: bytes) -> None:
        self._content = content

    def __len__(self) -> int:
        return len(self._content)

    def to_bytes(self) -> bytes:
        return self._content


class Reader:
    """A feed with its inbox, and the fetches it wants."""

    def __init__(self) -> None:
        self.rejections = Rejections(lambda: 0)
        codec = Codec(LOG, self.rejections)
        self._inbox = QueueInbox(codec, 10_000, ThreadBell(), lambda: 0)
        self.wanted: list[lossless.Fetch] = []
        self.feed = lossless.LosslessFeed(codec, self._inbox, lambda: 0, self.wanted.append)

    def numbers(self) -> list[int]:
        return [received.message.steps[0].seq for received in self._inbox.drain()]


def test_missing_messages_are_fetched_from_the_publishers_cache() -> None:
    reader = Reader()
    reader.feed.on_sample(FakeSample(3))
    (fetch,) = reader.wanted
    assert fetch.selector == "env/env0/log/@adv/pub/zid/7/**?_sn=0..3"
    for number in (0, 1, 2, 3):
        fetch.on_sample(FakeSample(number))
    fetch.done()
    assert reader.numbers() == [0, 1, 2, 3]
    assert len(reader.wanted) == 1


def test_an_unreachable_publisher_is_asked_again_and_then_given_up() -> None:
    reader = Reader()
    reader.feed.on_sample(FakeSample(0))
    reader.feed.on_sample(FakeSample(2))
    for tries in range(1, lossless.FETCH_TRIES + 1):
        assert len(reader.wanted) == tries
        reader.wanted[-1].done()
    assert len(reader.wanted) == lossless.FETCH_TRIES
    assert reader.wanted[-1].pause_s == lossless.FETCH_PAUSE_S
    assert reader.numbers() == [0, 2]


def test_a_publisher_that_comes_back_fills_the_gap() -> None:
    reader = Reader()
    reader.feed.on_sample(FakeSample(0))
    reader.feed.on_sample(FakeSample(2))
    reader.wanted[0].done()
    for number in (1, 2):
        reader.wanted[1].on_sample(FakeSample(number))
    reader.wanted[1].done()
    assert reader.numbers() == [0, 1, 2]
    assert len(reader.wanted) == 2


def test_a_cache_that_has_no_more_is_not_asked_again() -> None:
    reader = Reader()
    reader.feed.on_sample(FakeSample(5))
    for number in (4, 5):
        reader.wanted[0].on_sample(FakeSample(number))
    reader.wanted[0].done()
    assert reader.numbers() == [4, 5]
    assert len(reader.wanted) == 1


def test_a_damaged_message_is_counted_and_fetched_again() -> None:
    reader = Reader()
    reader.feed.on_sample(FakeSample(0))
    reader.feed.on_sample(FakeSample(1, b"damaged"))
    reader.feed.on_sample(FakeSample(2))
    (fetch,) = reader.wanted
    for number in (1, 2):
        fetch.on_sample(FakeSample(number))
    fetch.done()
    assert reader.numbers() == [0, 1, 2]
    assert reader.rejections.counts() == {"log": 1}


def test_what_has_no_number_is_passed_on_as_it_comes() -> None:
    reader = Reader()
    for number in (5, 5, 1):
        reader.feed.on_sample(FakeSample(number, numbered=False))
    assert reader.numbers() == [5, 5, 1]
    assert reader.wanted == []
