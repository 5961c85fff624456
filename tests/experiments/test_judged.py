from __future__ import annotations

from pathlib import Path

import pytest

from experiments import judged


@pytest.fixture(autouse=True)
def _short_units(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(judged, "TICKS", 40)


def test_a_line_is_forecast_and_noise_is_not(tmp_path: Path) -> None:
    line, noise = (judged.run(drift, 0, 70, tmp_path) for drift in ("line", "noise"))
    assert [one.window for one in line] == [one.window for one in noise] == [1, 2, 3, 4, 5]
    assert all(one.error < one.baseline_error for one in line[1:])
    assert line[-1].trust > 0.4
    assert sum(one.error for one in noise) > 1.5 * sum(one.baseline_error for one in noise)
    assert noise[-1].trust < 0.1
