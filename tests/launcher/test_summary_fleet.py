"""A fleet's totals and its environments' rows, by the hand-made ledgers of three environments."""

from __future__ import annotations

from typing import Any

import pytest

from launcher.fates import FATES
from launcher.summary import discrepancies, summarise
from launcher.totals import add_up, together
from rtcore.channels import AGENT, ENV_SERVER, LEARNER
from rtcore.messages import Stats
from tests.launcher.ledgers import FLEET, agent_life, fleet_run, ledger

RESTARTS = {"env_server.2": 1, "agent_service.2": 1, "agent_service.0": 2, "learner": 1}


def summary_of(stats: dict[str, list[Stats]]) -> dict[str, Any]:
    return summarise(FLEET, "r1", stats, wall_s=4.5, restarts=RESTARTS, ended="duration")


def test_the_totals_are_those_of_all_environments() -> None:
    summary = summary_of(fleet_run())
    assert (summary["env_count"], summary["ticks"], summary["resets"], summary["episodes"]) == (3, 350, 4, 4)
    assert summary["returns"] == [-30.0, -10.0, -5.0, 7.0]  # by environment, then by episode
    assert summary["mean_return"] == -38.0 / 4
    assert summary["deadlines"]["missed"] == 4
    assert summary["deadlines"]["down"] == 10
    assert summary["transitions"] == {
        "produced": 346, "learned": 344, "lost": 2, "duplicate": 5, "unread": 0
    }  # fmt: skip
    assert summary["loop_us"]["max"] == 700.0  # of env1
    assert summary["pacing_error_us"]["max"] == 9.0  # of env0
    assert summary["restarts"] == {ENV_SERVER: 1, AGENT: 3, LEARNER: 1, "recorder": 0}
    assert discrepancies(summary) == []


def test_run_time_is_one_environments_not_the_sum() -> None:
    # env0 passed 200 + 50 deadlines at 100 Hz, the others fewer: 250 steps in 2.5 s.
    assert summary_of(fleet_run())["learner"]["updates_per_s"] == 100.0


def test_each_environment_has_its_row() -> None:
    rows = summary_of(fleet_run())["envs"]
    assert list(rows) == ["env0", "env1", "env2"]
    assert rows["env1"] == {
        "ticks": 100,
        "resets": 1,
        "episodes": 1,
        "mean_return": -5.0,
        "missed": 1,
        "miss_ratio": 0.01,
        "overruns": 0,
        "skipped": 0,
        "down": 0,
        "produced": 99,
        "learned": 97,
        "lost": 2,
        "duplicate": 5,
        "adopted": 2,
        "unreceived": 1,
        "restarts": {ENV_SERVER: 0, AGENT: 0},
    }
    second = rows["env2"]
    assert (second["ticks"], second["down"], second["adopted"]) == (50, 10, 4)  # over its lives
    assert second["restarts"] == {ENV_SERVER: 1, AGENT: 1}
    assert rows["env0"]["restarts"] == {ENV_SERVER: 0, AGENT: 2}


def test_a_policy_has_a_fate_with_each_agent() -> None:
    """4 x 3 + 1: agent 2 had policy 2 ready when it was killed, got it again, and then 3 and 4. Agent 1
    did not live for policy 4."""
    policies = summary_of(fleet_run())["policies"]
    assert {name: policies[name] for name in ("published", *FATES, "received_again")} == {
        "published": 4,
        "adopted": 9,
        "rejected": 1,
        "superseded": 1,
        "unused": 1,
        "unreceived": 1,
        "received_again": 1,
    }


def test_what_one_agent_got_again_is_not_anothers() -> None:
    """Two agents that both began with policy 1: lives of one agent, they would have got it twice."""
    learner = ledger(LEARNER, counters={"published": 1})
    lives = {
        name: [agent_life(name, n, first=1, newest=1, received=1, adopted=1)]
        for n, name in enumerate(("agent_service.0", "agent_service.1", "agent_service.2"), 1)
    }
    summary = summary_of({**lives, LEARNER: [learner]})
    assert summary["policies"]["received_again"] == 0
    assert summary["policies"]["adopted"] == 3
    assert discrepancies(summary) == []


@pytest.mark.parametrize(
    ("process", "counter", "by", "words"),
    [
        # What one environment has too many and another too few is right in total.
        (
            ("env_server.0", "env_server.1"),
            "resets",
            1,
            ["env0: ticks = produced + resets: 200 != 201", "env1: ticks = produced + resets: 100 != 99"],
        ),
        ((LEARNER,), "learned.env2", 3, ["env2: lost >= 0: it is -3", "learned + unread = sum over the env"]),
        ((LEARNER,), "learned", -1, ["learned + unread = sum over the environments: 343 != 344"]),
        ((LEARNER,), "duplicate.env0", 2, ["duplicate = sum over the environments: 5 != 7"]),
        (
            ("agent_service.0", "agent_service.1"),
            "policies.received",
            1,
            ["env0: unreceived >= 0: it is -1", "published x 3 + received_again"],
        ),
    ],
)
def test_what_does_not_reconcile_is_named_with_its_environment(
    process: tuple[str, ...], counter: str, by: int, words: list[str]
) -> None:
    stats = fleet_run()
    for name, sign in zip(process, (1, -1), strict=False):
        counters = stats[name][0].counters
        counters[counter] = counters.get(counter, 0) + sign * by
    if counter == "policies.received":  # adopted by the one instead of by the other
        stats["agent_service.1"][0].counters["policies.adopted"] -= 2
    found = discrepancies(summary_of(stats))
    for one in words:
        assert any(line.startswith(one) for line in found), (one, found)


def test_totals_that_are_not_their_sum_are_named() -> None:
    summary = summary_of(fleet_run())
    for section, name in (("deadlines", "missed"), ("policies", "adopted"), ("transitions", "produced")):
        summary[section][name] += 1
    summary["restarts"][AGENT] = 0
    found = [line for line in discrepancies(summary) if "sum over" in line]
    assert found == [
        "missed = sum over the environments: 5 != 4",
        "produced = sum over the environments: 347 != 346",
        "adopted = sum over the environments: 10 != 9",
        f"restarts of {AGENT} = sum over the environments: 0 != 3",
    ]


def test_what_never_reached_a_table_is_lost_in_total_and_of_no_environment() -> None:
    stats = fleet_run()
    stats[LEARNER][0].counters["unread"] = 4
    summary = summary_of(stats)
    assert (summary["transitions"]["learned"], summary["transitions"]["lost"]) == (340, 6)
    assert summary["transitions"]["unread"] == 4
    assert discrepancies(summary) == []


def test_putting_processes_together_changes_none_of_them() -> None:
    parts = [add_up(fleet_run()[f"env_server.{i}"]) for i in range(2)]
    whole = together(parts)
    assert whole.histograms["loop"].count == 2
    assert [part.histograms["loop"].count for part in parts] == [1, 1]
    assert [len(part.returns) for part in parts] == [2, 1]
    assert whole.counters["ticks"] == 300 and parts[0].counters["ticks"] == 200


def test_strangers_are_left_out() -> None:
    stats = fleet_run()
    plain = summary_of(stats)
    stats["env_server.7"] = [ledger("env_server.7", counters={"ticks": 1000})]
    stats[ENV_SERVER] = [ledger(ENV_SERVER, counters={"ticks": 1000})]
    assert summary_of(stats) == plain


def test_a_fleet_in_which_nothing_happened() -> None:
    summary = summarise(FLEET, "r1", {}, wall_s=0.0, restarts={})
    assert discrepancies(summary) == []
    assert summary["envs"]["env0"]["mean_return"] is None
    assert summary["envs"]["env0"]["miss_ratio"] is None
