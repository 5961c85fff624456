"""Health, row by row."""

from __future__ import annotations

from typing import Any

import pytest

from rtcore import channels
from rtcore.channels import Channel
from rtcore.health import Health, expected_hz, health

SECOND = 1_000_000_000
NOW = 1_000 * SECOND


@pytest.mark.parametrize(
    ("channel", "hz", "expected"),
    [
        (channels.STEP, 100.0, 100.0),
        (channels.ACTION, 0.5, 0.5),
        (channels.LOG, 1000.0, 20.0),
        (channels.LOG, 5.0, 5.0),  # a batch has at least one step
        (channels.STATS, 1.0, 4.0),
        (channels.POLICY, 100.0, 0.0),
    ],
)
def test_expected_rate(channel: Channel[Any], hz: float, expected: float) -> None:
    assert expected_hz(channel, hz) == expected


@pytest.mark.parametrize("channel", channels.TABLE, ids=lambda channel: channel.name)
def test_what_never_came_is_missing(channel: Channel[Any]) -> None:
    assert health(channel, 100.0, None, NOW) == "missing"


@pytest.mark.parametrize(
    ("age_s", "judged"),
    [(0.0, "alive"), (2.0, "alive"), (2.001, "late"), (10.0, "late"), (10.001, "missing")],
)
def test_silence_on_a_fast_channel(age_s: float, judged: Health) -> None:
    # max_age_s is 2; gone after five times that
    assert health(channels.STEP, 100.0, NOW - round(age_s * SECOND), NOW) == judged


@pytest.mark.parametrize(
    ("age_s", "judged"), [(8.0, "alive"), (8.001, "late"), (40.0, "late"), (40.001, "missing")]
)
def test_a_slow_world_may_be_silent_for_two_periods(age_s: float, judged: Health) -> None:
    # 0.25 Hz: one step every 4 s
    assert health(channels.STEP, 0.25, NOW - round(age_s * SECOND), NOW) == judged


@pytest.mark.parametrize(
    "channel", [channels.SPEC, channels.POLICY, channels.WINDOW], ids=lambda row: row.name
)
def test_what_comes_on_occasion_never_gets_old(channel: Channel[Any]) -> None:
    assert health(channel, 100.0, 0, NOW, 0.0) == "alive"


@pytest.mark.parametrize(
    ("channel", "hz", "rate", "judged"),
    [
        (channels.STEP, 100.0, 50.0, "alive"),
        (channels.STEP, 100.0, 49.9, "late"),
        (channels.STEP, 100.0, None, "alive"),
        (channels.LOG, 1000.0, 10.0, "alive"),
        (channels.LOG, 1000.0, 9.0, "late"),
        (channels.LOG, 4.0, 4.0, "alive"),
        (channels.STATS, 100.0, 3.0, "alive"),
        (channels.STATS, 100.0, 1.0, "late"),
    ],
)
def test_fewer_than_half_of_the_promised_messages_is_late(
    channel: Channel[Any], hz: float, rate: float | None, judged: Health
) -> None:
    assert health(channel, hz, NOW, NOW, rate) == judged


def test_silence_outweighs_a_good_rate() -> None:
    assert health(channels.STATS, 100.0, NOW - 11 * SECOND, NOW, 4.0) == "missing"
