"""Whether a sender keeps what its row in the channel table promises."""

from __future__ import annotations

from typing import Any, Literal

from rtcore.channels import Channel, Delivery

Health = Literal["alive", "late", "missing"]

LATE_PERIODS = 2  # a slow channel may be silent for two of its periods, whatever `max_age_s` says
MISSING_AGES = 5  # silent for five times as long as makes it late: taken for gone
MIN_RATE_SHARE = 0.5  # of the promised rate; a count over one second of 4 Hz is off by a quarter


def expected_hz(channel: Channel[Any], hz: float) -> float:
    """Messages per second that the row promises at a control rate of `hz`; 0: on occasion.

    A batch of steps leaves as soon as its time is up, but never without a step: a lossless channel is
    no faster than the control rate.
    """
    if channel.rate_hz is None:
        return hz
    return min(channel.rate_hz, hz) if channel.delivery is Delivery.LOSSLESS else channel.rate_hz


def health(
    channel: Channel[Any], hz: float, last_seen_ns: int | None, now_ns: int, rate: float | None = None
) -> Health:
    """Judge a channel by its newest message and its rate.

    Args:
        channel: the row.
        hz: the run's control rate, > 0.
        last_seen_ns: when the newest message came; None: none ever did.
        now_ns: now, on the same clock.
        rate: messages per second measured over the last second or more; None: not known.

    Returns:
        "missing": nothing came yet, or for so long that the sender counts as gone. "late": it is older
        than the row allows, or fewer than half of the promised messages come. Else "alive".
    """
    if last_seen_ns is None:
        return "missing"
    promised_hz = expected_hz(channel, hz)
    if channel.max_age_s is not None:
        slowest_s = LATE_PERIODS / promised_hz if promised_hz > 0 else 0.0
        limit_s = max(channel.max_age_s, slowest_s)
        age_s = (now_ns - last_seen_ns) / 1e9
        if age_s > MISSING_AGES * limit_s:
            return "missing"
        if age_s > limit_s:
            return "late"
    if rate is not None and rate < MIN_RATE_SHARE * promised_hz:
        return "late"
    return "alive"
