"""What makes a lossless channel lossless on top of Zenoh: order, late history, repair."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rtcore.channels import MessageT
from rtcore.codec import Codec
from rtcore.inbox import Inbox
from rtcore.ordering import SourceOrder

# Together as long as a link took to come back at worst (1.2 s in 24 kill -9) and again as much.
FETCH_TRIES, FETCH_PAUSE_S = 25, 0.1


class Payload(Protocol):
    """The bytes of a sample, not copied yet."""

    def __len__(self) -> int: ...

    def to_bytes(self) -> bytes:
        """A copy."""


class Sample(Protocol):
    """What is needed of a Zenoh sample."""

    @property
    def key_expr(self) -> object:
        """Its key."""

    @property
    def payload(self) -> Payload:
        """Its bytes."""

    @property
    def source_info(self) -> Any:
        """The publisher and its number for this sample, or None."""


class Fetch:
    """One query to a publisher's cache: ask for `selector` after `pause_s`, give each sample to `on_sample`,
    and call `done` after the last.

    It asks for one number more than is missing, the one that came. The cache answers in order, so that
    one's arrival tells a cache that has no more from a publisher that cannot be reached: a gap often shows
    at the moment when a link is lost. Then it asks again, for the time that a reconnection takes.
    """

    def __init__(self, feed: LosslessFeed, source: str, key: object, first: int, last: int) -> None:
        # The key is the one by which Zenoh itself asks a publisher's cache.
        self.selector = f"{key}/@adv/pub/{source}/**?_sn={first}..{last}"
        self.pause_s = 0.0
        self._feed = feed
        self._source = source
        self._last = last
        self._complete = False
        self._tries = FETCH_TRIES

    def on_sample(self, sample: Sample) -> None:
        """Take a sample from the cache, on any of Zenoh's threads."""
        number = self._feed.on_fetched(self._source, sample)
        self._complete |= number == self._last

    def done(self) -> None:
        """The query has ended."""
        self._tries -= 1
        if self._complete or self._tries == 0:
            self._feed.order.fetched(self._source)
        else:
            self.pause_s = FETCH_PAUSE_S
            self._feed.want(self)


class LosslessFeed:
    """Hands samples on to an inbox in each publisher's order, and fetches those that are missing.

    Its input is an advanced subscriber, which has already recovered what it could.
    """

    def __init__(
        self, codec: Codec[MessageT], inbox: Inbox, now_ns: Callable[[], int], want: Callable[[Fetch], None]
    ) -> None:
        """`want` must only take note: it is called from within Zenoh."""
        self.order: SourceOrder[tuple[bytes, int]] = SourceOrder(lambda item: inbox.offer(*item))
        self.want = want
        self._fits, self._intact = codec.fits, codec.intact
        self._now_ns = now_ns
        self._offer = inbox.offer

    def on_sample(self, sample: Sample) -> None:
        """Take a sample, on any of Zenoh's threads."""
        item = self._item(sample)
        if item is None:
            return
        info = sample.source_info
        if info is None:  # not from a publisher of ours; nothing to put in order
            self._offer(*item)
            return
        source = f"{info.source_id.zid}/{info.source_id.eid}"
        first_missing = self.order.live(source, info.source_sn, item)
        if first_missing is not None:
            self.want(Fetch(self, source, sample.key_expr, first_missing, info.source_sn))

    def on_fetched(self, source: str, sample: Sample) -> int:
        """Take a sample from a cache; returns its number, -1 for none."""
        info = sample.source_info
        if info is None:
            return -1
        number: int = info.source_sn
        item = self._item(sample)
        if item is not None:
            self.order.history(source, number, item)
        return number

    def _item(self, sample: Sample) -> tuple[bytes, int] | None:
        """The bytes and their stamp; None, counted, if damaged: then the number is missing."""
        received_ns = self._now_ns()
        if not self._fits(len(sample.payload)):
            return None
        payload = sample.payload.to_bytes()
        return (payload, received_ns) if self._intact(payload) else None
