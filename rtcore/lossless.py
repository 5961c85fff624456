"""What the Zenoh bus does on top of Zenoh to make a lossless channel lossless: order, late history, repair."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from rtcore.channels import MessageT
from rtcore.codec import Codec
from rtcore.inbox import Inbox
from rtcore.ordering import SourceOrder


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


Fetch = Callable[[str, Callable[[Sample], None], Callable[[], None]], None]


class LosslessFeed:
    """Hands samples on to an inbox in each publisher's order, and fetches those that are missing.

    Its input is an advanced subscriber, which has already recovered what it could.
    """

    def __init__(self, codec: Codec[MessageT], inbox: Inbox, now_ns: Callable[[], int], fetch: Fetch) -> None:
        """`fetch(selector, on_sample, done)` starts a query; `done` follows its last sample."""
        self._fits, self._intact = codec.fits, codec.intact
        self._now_ns = now_ns
        self._fetch = fetch
        self._offer = inbox.offer
        self._order: SourceOrder[tuple[bytes, int]] = SourceOrder(lambda item: inbox.offer(*item))

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
        missing = self._order.live(source, info.source_sn, item)
        if missing is not None:  # the key is the one by which Zenoh itself asks a publisher's cache
            selector = f"{sample.key_expr}/@adv/pub/{source}/**?_sn={missing[0]}..{missing[1]}"
            self._fetch(selector, partial(self._on_fetched, source), partial(self._order.fetched, source))

    def _on_fetched(self, source: str, sample: Sample) -> None:
        item = self._item(sample)
        if item is not None and sample.source_info is not None:
            self._order.history(source, sample.source_info.source_sn, item)

    def _item(self, sample: Sample) -> tuple[bytes, int] | None:
        """The bytes and their stamp; None, counted, if damaged: then the number is missing."""
        received_ns = self._now_ns()
        if not self._fits(len(sample.payload)):
            return None
        payload = sample.payload.to_bytes()
        return (payload, received_ns) if self._intact(payload) else None
