from __future__ import annotations

import json
from typing import Literal

import pytest

from learner.forecast.judge import Judge


def test_trust_is_earned_and_lost() -> None:
    judge = Judge("judged")
    shares = [judge.share]
    for error, baseline_error in ((0.5, 2.0), (0.0, 1.0), (3.0, 1.0)):
        judge.hear(error, baseline_error)
        shares.append(judge.share)
    # 0.3 * 0.75 = 0.225; 0.7 * 0.225 + 0.3 * 1 = 0.4575; a loss counts as 0: 0.7 * 0.4575
    assert shares == pytest.approx([0.0, 0.225, 0.4575, 0.32025])


@pytest.mark.parametrize("error", [0.0, 1.0])
def test_where_nothing_moved_nothing_is_earned(error: float) -> None:
    judge = Judge("judged")
    judge.hear(0.0, 1.0)
    judge.hear(error, 0.0)
    assert judge.share == pytest.approx(0.7 * 0.3)


@pytest.mark.parametrize(
    ("error", "baseline"), [(float("nan"), 1.0), (1.0, float("nan")), (float("inf"), 1.0)]
)
def test_what_is_no_number_earns_nothing(error: float, baseline: float) -> None:
    judge = Judge("judged")
    judge.hear(error, baseline)
    assert judge.share == 0.0


@pytest.mark.parametrize(("trust", "share"), [("always", 1.0), ("never", 0.0)])
def test_trust_may_be_set(trust: Literal["always", "never"], share: float) -> None:
    judge = Judge(trust)
    assert judge.share == share
    judge.hear(0.5, 1.0)
    assert judge.share == judge.metrics()["forecast/trust"] == share


def test_metrics() -> None:
    judge = Judge("judged")
    assert judge.metrics() == {"forecast/windows": 0.0, "forecast/trust": 0.0}
    judge.hear(1.0, 2.0)
    judge.hear(2.0, 6.0)
    assert judge.metrics() == pytest.approx(
        {
            "forecast/windows": 2.0,
            "forecast/error": 1.5,
            "forecast/baseline_error": 4.0,
            "forecast/last_error": 2.0,
            "forecast/last_baseline_error": 6.0,
            "forecast/trust": 0.7 * 0.15 + 0.3 * (1 - 2 / 6),
        }
    )


def test_it_goes_on_from_its_state() -> None:
    judge, other = Judge("judged"), Judge("judged")
    judge.hear(1.0, 2.0)
    other.load(json.loads(json.dumps(judge.state())))
    for one in (judge, other):
        one.hear(2.0, 6.0)
    assert other.metrics() == judge.metrics()
