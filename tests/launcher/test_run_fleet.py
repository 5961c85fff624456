"""What `tenuto run` makes of a fleet: who takes part, why it ended, what is told."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from launcher import options, run
from launcher.cli import run_command
from launcher.restarts import Happening
from launcher.supervisor import End
from launcher.watch import Watch
from rtcore import cast
from rtcore.config import ConfigError, LinkConfig, RecorderConfig
from rtcore.run_dir import RunDir
from tests.launcher.ledgers import CONFIG, FLEET, ledger


def test_who_takes_part() -> None:
    assert run._wanted(CONFIG) == ("env_server", "agent_service", "learner", "recorder")
    assert run._wanted(FLEET) == cast.names(FLEET)
    without = replace(FLEET, recorder=RecorderConfig(record=False))
    assert run._wanted(without) == cast.names(FLEET)[:-1]


def test_certificates_are_per_role(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def require(link: LinkConfig, roles: Iterable[str]) -> None:
        asked.append(list(roles))
        raise ConfigError("secure", link.secure, "enough")

    monkeypatch.setattr(options, "require_keys", require)
    arguments = ["run", "pointmass", "--env.count", "3", "--link.secure", "k"]
    assert run_command(arguments) == 2
    assert asked == [["env_server", "agent_service", "learner", "recorder", "operator"]]


@pytest.mark.parametrize(
    ("ticks", "why"),
    [((200, 190, 200), "duration"), ((200, 190, 199), "stopped"), ((200, 190, 0), "stopped")],
)
def test_it_ended_with_its_duration_if_all_environments_did(ticks: tuple[int, ...], why: str) -> None:
    """2 s at 100 Hz; the second one skipped 10 deadlines."""
    watch = Watch(100.0)
    for i, count in enumerate(ticks):
        counters = {"ticks": count, "skipped": 200 - 190 if i == 1 else 0}
        watch.feed(ledger(f"env_server.{i}", counters=counters), 0)
    assert run._why(End("duration"), FLEET, watch) == why


@pytest.mark.parametrize(("ticks", "why"), [(4_319_999, "duration"), (4_319_998, "stopped")])
def test_the_duration_is_counted_as_the_env_servers_count_it(ticks: int, why: str) -> None:
    """7200 s at 600 Hz: a period of 1 666 667 ns fits 4 319 999 times."""
    watch, config = Watch(600.0), replace(CONFIG, duration_s=7200.0, env=replace(CONFIG.env, hz=600.0))
    watch.feed(ledger("env_server", counters={"ticks": ticks}), 0)
    assert run._why(End("duration"), config, watch) == why


def test_what_happened_names_the_process(tmp_path: Path) -> None:
    run_dir = RunDir.create(tmp_path / "r1", FLEET)
    died = Happening(3_000_000_000, "agent_service.2", "died", -9, "x")
    assert run._told([died], run_dir, 1_000_000_000) == [
        {"at_s": 2.0, "process": "agent_service.2", "what": "died", "code": -9}
    ]
