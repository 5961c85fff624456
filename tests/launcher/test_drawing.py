from __future__ import annotations

import pytest

from launcher import drawing


@pytest.mark.parametrize(
    ("values", "width", "bars"),
    [
        ([], 5, ""),
        ([3.0, 3.0], 5, "▅▅"),
        ([0.0, 1.0], 5, "▁█"),
        ([0.0, 3.5, 7.0], 5, "▁▅█"),
        ([100.0, 0.0, 7.0], 2, "▁█"),  # only the newest two count, for the scale too
    ],
)
def test_sparkline(values: list[float], width: int, bars: str) -> None:
    assert drawing.sparkline(values, width) == bars


@pytest.mark.parametrize(
    ("ratio", "text"),
    [(None, "·"), (0.0, "0.00 %"), (0.25, "25.0 %"), (0.0123, "1.23 %"), (0.00001, "0.0010 %")],
)
def test_share(ratio: float | None, text: str) -> None:
    assert drawing.share(ratio) == text


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.0, "0:00"), (125.9, "2:05"), (3725.0, "1:02:05"), (-1.0, "0:00")]
)
def test_clock(seconds: float, text: str) -> None:
    assert drawing.clock(seconds) == text


@pytest.mark.parametrize(("value", "text"), [(None, "·"), (0.34, "0.3"), (12.6, "13"), (12345.6, "12,346")])
def test_microseconds(value: float | None, text: str) -> None:
    assert drawing.microseconds(value) == text
