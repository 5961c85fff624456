from __future__ import annotations

import json
from typing import Any

import pytest

from launcher.fates import FATES
from launcher.summary import discrepancies, summarise
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, RECORDER
from rtcore.messages import CAUSES
from tests.launcher.ledgers import CONFIG, agent_ledger, agent_life, env_ledger, episode, ledger, whole_run

NOBODY = dict.fromkeys(CAUSES, 0)


def summary_of(stats: dict[str, Any]) -> dict[str, Any]:
    return summarise(CONFIG, "r1", stats, wall_s=4.5, restarts={}, ended="duration")


def test_the_whole_summary_of_a_small_run() -> None:
    nothing = {"p50": None, "p99": None, "p999": None, "max": None}
    summary = summary_of(whole_run())
    pacing = summary.pop("pacing_error_us")
    assert pacing["p50"] == pytest.approx(1.0, rel=0.01)
    assert pacing["max"] == 9.0
    assert summary == {
        "schema": 1,
        "run": "r1",
        "preset": "pointmass",
        "env": "pointmass",
        "env_count": 1,
        "algo": "sac",
        "seed": 4,
        "tick_hz": 100.0,
        "unit_s": 1.0,
        "wall_s": 4.5,
        "clock": "wall",
        "ended": "duration",
        "forced": [],
        "ticks": 200,
        "resets": 2,
        "episodes": 2,
        "mean_return": -20.0,
        "returns": [-30.0, -10.0],
        "deadlines": {
            "missed": 3,
            "miss_ratio": 0.015,
            "overruns": 1,
            "skipped": 50,
            "down": 0,
            "missed_by_cause": {**NOBODY, "agent_late": 2, "env_late": 1},
        },
        "reaction_us": dict.fromkeys(nothing, 80.0),
        "loop_us": dict.fromkeys(nothing, 500.0),
        "policies": {
            "published": 4,
            "adopted": 1,
            "rejected": 1,
            "superseded": 1,
            "unused": 0,
            "unreceived": 1,
            "received_again": 0,
            "foreign": 0,
            "published_in_hold": 0,
            "withheld": 0,
            "last_version": 4,
            "publish_to_adopt_ms": {"p50": 4.0, "p99": 4.0, "max": 4.0},
        },
        "windows": [{"m": 0, "t_m": 0, "G": 7, "N": 3}, {"m": 1, "t_m": 10, "G": 7, "N": 3}],
        "operator_holds": 1,
        "transitions": {"produced": 198, "learned": 197, "lost": 1, "duplicate": 5},
        "learner": {
            "gradient_steps": 250,
            "policy_steps": 100,
            "updates_per_s": 100.0,  # in 2.5 s
            "governor": {"decisions": 0, "limited_share": None},
        },
        "forecast": {"windows": None, "error": None, "baseline_error": None, "trust": None},
        "recorder": {"rows": 900, "dropped": 7, "live_dropped": 0},
        "supervision": [],
        "restarts": {"env_server": 0, "agent_service": 0, "learner": 0, "recorder": 0},
        "messages": {
            "rejected": 3,
            "denied": 0,
            "links_refused": 0,
            "unsent": 0,
            "events_dropped": 0,
            "by_channel": {"action": 2, "policy": 1},
        },
        "disk": {
            "transitions": 0, "checkpoints": 0, "diary_entries": 0, "policies": 0, "schedules": 0,
            "tallies": 0, "rows": 0,
        },
    }  # fmt: skip
    assert discrepancies(summary) == []


def test_what_the_disk_did_not_take_is_told() -> None:
    summary = summary_of(
        {
            LEARNER: [
                ledger(LEARNER, counters={"replay.unbacked": 40, "checkpoint.errors": 2}),
                ledger(LEARNER, incarnation=2, counters={"schedule_file.errors": 4}),
            ],
            RECORDER: [ledger(RECORDER, counters={"disk_dropped": 5, "tally.unbacked": 1, "dropped": 7})],
            AGENT: [ledger(AGENT, counters={"policy_file.errors": 3, "tally.unbacked": 1})],
        }
    )
    assert summary["disk"] == {
        "transitions": 40, "checkpoints": 2, "diary_entries": 0, "policies": 3, "schedules": 4, "tallies": 2,
        "rows": 5,
    }  # fmt: skip


def test_what_was_told_to_nobody_is_counted() -> None:
    summary = summary_of(
        {
            AGENT: [ledger(AGENT, counters={"stats.unsent": 2, "events.dropped": 10})],
            LEARNER: [ledger(LEARNER, counters={"stats.unsent": 1})],
            RECORDER: [ledger(RECORDER, counters={"rows": 9, "dropped": 7, "live_dropped": 40})],
        }
    )
    assert (summary["messages"]["unsent"], summary["messages"]["events_dropped"]) == (3, 10)
    assert summary["recorder"] == {"rows": 9, "dropped": 7, "live_dropped": 40}


def test_the_governors_share_is_of_the_ticks_that_it_saw() -> None:
    counters = {"governor.decisions": 3, "governor.ticks": 200, "governor.limited_ticks": 50}
    summary = summary_of({LEARNER: [ledger(LEARNER, counters=counters)]})
    assert summary["learner"]["governor"] == {"decisions": 3, "limited_share": 0.25}


def test_incarnations_are_added_up() -> None:
    stats = whole_run()
    later = ledger(
        ENV_SERVER,
        incarnation=9,
        counters={"ticks": 100, "resets": 1, "produced": 99, "missed": 1, "missed.agent_absent": 1},
        histograms={"loop": [700_000, 700_000, 700_000]},
        returns=[episode(0, 10.0)],
    )
    stats[ENV_SERVER] = [later, *stats[ENV_SERVER]]
    summary = summary_of(stats)
    assert summary["ticks"] == 300
    assert summary["returns"] == [-30.0, -10.0, 10.0]
    assert summary["mean_return"] == -10.0
    assert summary["deadlines"]["missed_by_cause"] == {
        **NOBODY,
        "agent_late": 2,
        "agent_absent": 1,
        "env_late": 1,
    }
    assert summary["loop_us"]["p50"] == pytest.approx(700.0, rel=0.01)
    assert summary["transitions"]["produced"] == 297
    assert summary["transitions"]["lost"] == 100


def test_a_run_in_which_nothing_happened() -> None:
    summary = summary_of({})
    assert summary["mean_return"] is None
    assert summary["deadlines"]["miss_ratio"] is None
    assert summary["learner"]["updates_per_s"] is None
    assert summary["loop_us"] == {"p50": None, "p99": None, "p999": None, "max": None}
    assert summary["windows"] == []
    assert discrepancies(summary) == []
    assert json.loads(json.dumps(summary)) == summary


def test_a_judged_forecast() -> None:
    stats = whole_run()
    gauges = {"windows": 6.0, "error": 0.5, "baseline_error": 0.75, "trust": 0.25, "last_error": 0.1}
    gauges = {f"forecast/{name}": value for name, value in gauges.items()}
    stats[LEARNER].append(ledger(LEARNER, incarnation=2, gauges=gauges))
    assert summary_of(stats)["forecast"] == {
        "windows": 6,
        "error": 0.5,
        "baseline_error": 0.75,
        "trust": 0.25,
    }


def test_what_never_reached_the_table_is_lost() -> None:
    stats = whole_run()
    (learner,) = stats[LEARNER]
    learner.counters["unread"] = 7
    plain, found = summary_of(whole_run())["transitions"], summary_of(stats)["transitions"]
    assert (found["learned"], found["lost"]) == (plain["learned"] - 7, plain["lost"] + 7)


def test_counts_that_do_not_reconcile_are_named() -> None:
    stats = whole_run()
    env = env_ledger()
    env.counters["ticks"] = 201
    env.counters["missed"] = 4
    agent = agent_ledger()
    agent.counters["policies.adopted"] = 2
    found = discrepancies(summary_of({**stats, ENV_SERVER: [env], AGENT: [agent]}))
    assert found == [
        "ticks = produced + resets: 201 != 200",
        "published + received_again = adopted + rejected + superseded + unused + unreceived: 4 != 5",
        "missed = sum of its causes: 4 != 3",
    ]


def test_policies_reconcile_over_the_lives_of_an_agent() -> None:
    """Ten were published. The first life got 1..4, of which 4 was ready when it was killed; the second got
    4 again, and 5 and 6; nobody lived for 7; the third began with 8 and got 9, unused, and not 10, and
    somebody sent it 3 once more."""
    learner = ledger(LEARNER, counters={"published": 10, "last_version": 10})
    lives = [
        agent_life(AGENT, 1, final=False, first=1, newest=4, received=4, adopted=2, superseded=1),
        agent_life(AGENT, 2, final=True, first=4, newest=6, received=3, adopted=3),
        agent_life(
            AGENT, 3, final=True, first=8, newest=9, received=3, adopted=1, unused=1, rejected=1, past=1
        ),
    ]
    summary = summary_of({AGENT: lives[::-1], LEARNER: [learner]})
    found = {name: summary["policies"][name] for name in (*FATES, "received_again")}
    assert found == {
        "adopted": 6,
        "rejected": 1,
        "superseded": 1,
        "unused": 2,
        "unreceived": 2,
        "received_again": 2,
    }
    assert discrepancies(summary) == []


def test_policies_of_nobody_are_apart() -> None:
    learner = ledger(LEARNER, counters={"published": 1})
    lives = [agent_life(AGENT, 1, final=True, first=1, newest=1, received=1, adopted=1, foreign=2)]
    summary = summary_of({AGENT: lives, LEARNER: [learner]})
    assert summary["policies"]["foreign"] == 2
    assert discrepancies(summary) == []


def test_an_agent_that_received_more_than_there_was_is_named() -> None:
    learner = ledger(LEARNER, counters={"published": 1})
    lives = [agent_life(AGENT, n, final=True, first=n, newest=n, received=1, adopted=1) for n in (1, 2)]
    assert discrepancies(summary_of({AGENT: lives, LEARNER: [learner]})) == [
        "policies.unreceived >= 0: it is -1"
    ]


def test_the_last_version_is_not_added_up() -> None:
    lives = [ledger(LEARNER, incarnation=n, counters={"last_version": 5 * n}) for n in (1, 2)]
    assert summary_of({LEARNER: lives})["policies"]["last_version"] == 10


def test_deadlines_without_an_env_server_are_apart() -> None:
    stats = whole_run()
    later = ledger(ENV_SERVER, incarnation=9, counters={"ticks": 100, "produced": 100, "down": 50})
    summary = summary_of({**stats, ENV_SERVER: [*stats[ENV_SERVER], later]})
    assert {name: summary["deadlines"][name] for name in ("missed", "skipped", "down")} == {
        "missed": 3,
        "skipped": 50,
        "down": 50,
    }
    assert summary["learner"]["updates_per_s"] == 250 / 4.0  # 200 + 50 + 100 + 50 ticks at 100 Hz
