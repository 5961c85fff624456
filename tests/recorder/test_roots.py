"""Below which root an environment's entities lie, as they are written and as they are read back."""

from __future__ import annotations

import pytest

from recorder import reading
from recorder.rows import roots
from rtcore.config import EnvConfig


@pytest.mark.parametrize(
    ("env", "expected"),
    [
        (EnvConfig(), {"env0": ""}),
        (EnvConfig(count=2), {"env0": "/env0", "env1": "/env1"}),
        (EnvConfig(name="left arm", count=2), {"left arm0": "/left_arm0", "left arm1": "/left_arm1"}),
    ],
)
def test_only_in_a_fleet_entities_lie_below_the_environments_name(
    env: EnvConfig, expected: dict[str, str]
) -> None:
    assert roots(env) == expected


def test_the_roots_read_back_are_in_the_order_of_their_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = [f"/env{i}/{entity}" for i in (10, 9, 0) for entity in ("env/reward", "world/env/g1")]
    for found, expected in (
        ([*fleet, "/learner/loss/env", "/log"], ["/env0", "/env9", "/env10"]),
        (["/env/reward", "/world/agent/g1", "/world/body1/g1"], [""]),
        (["/log", "/run_card"], []),
    ):
        monkeypatch.setattr(reading, "entities", lambda _, found=found: found)
        assert reading.env_roots("r.rrd") == expected
