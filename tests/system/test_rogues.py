"""Rogues at a secured run of real processes: none has any effect, and each is seen."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from rtcore import channels
from tests.system import rogues
from tests.system.rogues import FORGERS, INTRUDERS, ROGUES, Traces, tampered_file

pytestmark = pytest.mark.timeout(120)
ENV_DENIED, AGENT_DENIED = (f"{process}.link.denied" for process in (channels.ENV_SERVER, channels.AGENT))
REJECTED, RECEIVED, FOREIGN = (
    f"{channels.AGENT}.policies.{what}" for what in ("rejected", "received", "foreign")
)


def play(home: Path) -> dict[str, Traces]:
    with ThreadPoolExecutor(2) as pool:
        runs = [
            pool.submit(rogues.play, home / name / "keys", who)
            for name, who in (("intruders", INTRUDERS), ("forgers", FORGERS))
        ]
        return runs[0].result() | runs[1].result()


@pytest.fixture(scope="module")
def traces(played: Callable[[str], Any]) -> dict[str, Traces]:
    found: dict[str, Traces] = played("test_rogues")
    return found


def test_the_honest_ones_are_refused_nothing(traces: dict[str, Traces]) -> None:
    counted = traces["nobody"].counted
    assert counted["env_server.ticks"] > 5
    assert not [name for name in counted if ".link." in name or name.endswith(("rejected", "foreign"))]


@pytest.mark.parametrize("rogue", [rogue.__name__ for rogue in ROGUES if rogue is not tampered_file])
def test_no_rogue_has_any_effect(traces: dict[str, Traces], rogue: str) -> None:
    found = traces[rogue]
    starts_anew = {0} if rogue == "replayed_to_a_new_agent" else set()
    assert found.versions - {-1} <= {3} | starts_anew  # -1: at a reset, or nobody answered
    assert found.version == 3
    assert found.ticked


@pytest.mark.parametrize(
    ("rogue", "text"),
    [("no_certificate", "peer sent no certificates"), ("another_authority", "invalid peer certificate")],
)
def test_who_has_no_certificate_of_ours_gets_no_link(
    traces: dict[str, Traces], rogue: str, text: str
) -> None:
    found = traces[rogue]
    assert found.returned == 0  # peers
    assert found.counted["env_server.link.refused"] > 0
    assert found.counted["agent_service.link.refused"] > 0
    assert f"link refused: {text}" in found.told
    assert found.counted[RECEIVED] == found.counted[FOREIGN] == 0


def test_each_policy_of_a_recorder_is_counted(traces: dict[str, Traces]) -> None:
    found = traces["recorder_publishes"]
    assert found.counted[AGENT_DENIED] >= found.returned
    assert "message refused: recorder may not Put (ingress) on tenuto/run/policy" in found.told
    assert found.counted[RECEIVED] == found.counted[FOREIGN] == 0


def test_each_action_of_a_recorder_is_counted(traces: dict[str, Traces]) -> None:
    found = traces["recorder_acts"]
    assert found.counted[ENV_DENIED] >= found.returned
    assert "message refused: recorder may not Put (ingress) on tenuto/run/env/env0/action" in found.told
    assert found.counted["env_server.ticks"] > 5


def test_an_order_of_a_recorder_is_counted(traces: dict[str, Traces]) -> None:
    found = traces["recorder_orders"]
    assert found.returned == 0
    assert found.counted[ENV_DENIED] > 0
    assert "recorder may not Query (ingress) on tenuto/run/control/env_server" in found.told


@pytest.mark.parametrize(
    ("rogue", "why"),
    [
        ("unsigned", "policy 9 refused: it is not signed"),
        ("other_weights", "policy 9 refused: its signature is not the learner's"),
        ("same_hash_claimed", "policy 9 refused: sha256 differs"),
        ("another_run", "policy 9 refused: its signature is not the learner's"),
        ("tampered_file", "policy 9 from a file refused: its signature is not the learner's"),
    ],
)
def test_each_policy_that_is_not_the_learners_is_counted_apart(
    traces: dict[str, Traces], rogue: str, why: str
) -> None:
    counted = traces[rogue].counted
    assert (counted[FOREIGN], counted[RECEIVED], counted[REJECTED]) == (1, 0, 0)
    assert why in traces[rogue].told
    assert 9 not in traces[rogue].versions


@pytest.mark.parametrize(("rogue", "version"), [("replayed", 1), ("replayed_to_a_new_agent", 2)])
def test_each_policy_of_the_learners_past_is_counted(
    traces: dict[str, Traces], rogue: str, version: int
) -> None:
    counted = traces[rogue].counted
    assert (counted[REJECTED], counted[f"{channels.AGENT}.policies.past"], counted[FOREIGN]) == (1, 1, 0)
    assert f"policy {version} refused: version 3 was there before" in traces[rogue].told
