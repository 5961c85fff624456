"""`summary.json`: what a run did, from its configuration and the ledgers of its processes. Pure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from statistics import fmean
from typing import Any, Literal

from launcher import fleet
from launcher.fates import FATES, fates
from launcher.totals import Totals, add_up, together
from rtcore import cast
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER
from rtcore.config import RunConfig
from rtcore.messages import CAUSES, Stats, WindowNotice

SCHEMA = 1
REJECTED = "messages.rejected."  # begins the counters of each channel
NOT_ON_DISK = {
    "transitions": "replay.unbacked",  # in memory alone: gone with the learner
    "checkpoints": "checkpoint.errors",
    "diary_entries": "diary.errors",
    "policies": "policy_file.errors",
    "schedules": "schedule_file.errors",
    "tallies": "tally.unbacked",  # lives whose counters die with them
    "rows": "disk_dropped",  # of the recording
}
PASSED = ("ticks", "skipped", "down")  # every deadline from T0 on is one of them

Summary = dict[str, Any]
StatsByProcess = Mapping[str, Sequence[Stats]]  # per process: the newest ledger of each incarnation


def summarise(
    config: RunConfig,
    run: str,
    stats: StatsByProcess,
    *,
    wall_s: float,
    restarts: Mapping[str, int],
    ended: str = "",
    forced: Sequence[str] = (),
    clock: Literal["wall", "virtual"] = "wall",
) -> Summary:
    """The whole summary.

    Args:
        config: the run's, resolved (`env.hz` is known).
        run: the run's name.
        stats: every process's ledgers; a process may be absent, and who is none of the run's is left out.
        wall_s: seconds from the start of the first process to the end of the last.
        restarts: how often each process was started again.
        ended: why the run ended, in a few words.
        forced: processes that had to be killed at the end.
        clock: what the run went by.
    """
    processes = {name: add_up(stats.get(name, ())) for name in cast.names(config)}
    of_role = {role: cast.of_role(config, role) for role in PROCESSES}
    totals = {role: together(processes[name] for name in names) for role, names in of_role.items()}
    env, learner, recorder = totals[ENV_SERVER], totals[LEARNER], totals[RECORDER]
    run_time_s = max(passed(processes[name]) for name in of_role[ENV_SERVER]) / (config.env.hz or math.inf)
    published = learner.counters["published"]
    became = {name: fates(published, stats.get(name, ())) for name in of_role[AGENT]}
    found = {
        **_about(config, run),
        "wall_s": wall_s,
        "clock": clock,
        "ended": ended,
        "forced": list(forced),
        **_world(env, totals[AGENT]),
        "policies": _policies(learner, totals[AGENT], stats.get(LEARNER, ()), list(became.values())),
        "windows": _windows(learner.windows),
        "operator_holds": learner.counters["operator_holds"],
        "transitions": _transitions(env, learner),
        "learner": _learner(learner, run_time_s),
        "forecast": _forecast(learner.gauges),
        "recorder": {name: recorder.counters[name] for name in ("rows", "dropped", "live_dropped")},
        "restarts": {role: sum(restarts.get(name, 0) for name in of_role[role]) for role in PROCESSES},
        "supervision": [],
        "messages": _messages(totals.values()),
        "disk": not_on_disk(totals.values()),
    }
    if config.env.count == 1:
        return found
    found["transitions"]["unread"] = learner.counters["unread"]
    return found | {"envs": fleet.rows(config, processes, became, restarts)}


def _world(env: Totals, agent: Totals) -> Summary:
    return {
        "ticks": env.counters["ticks"],
        "resets": env.counters["resets"],
        "episodes": env.counters["episodes"],
        "mean_return": fmean(env.returns) if env.returns else None,
        "returns": env.returns,
        "deadlines": _deadlines(env),
        "pacing_error_us": env.quantiles("pacing", 1e-3),
        "reaction_us": agent.quantiles("reaction", 1e-3),
        "loop_us": env.quantiles("loop", 1e-3),
    }


def _messages(totals: Collection[Totals]) -> Summary:
    """What came and was not taken: `rejected` for what it was, also by channel, `denied` for whom it was
    from, by access control; and the links that secured processes refused. What was to be told and was not:
    whole ledgers, `unsent`, which the next one made good, and lines of the timeline, which the log has.
    """
    counted = {
        "rejected": "messages.rejected",
        "denied": "link.denied",
        "links_refused": "link.refused",
        "unsent": "stats.unsent",
        "events_dropped": "events.dropped",
    }
    found: Summary = {
        name: sum(total.counters[counter] for total in totals) for name, counter in counted.items()
    }
    by_channel: Counter[str] = Counter()
    for total in totals:
        for name, count in total.counters.items():
            if name.startswith(REJECTED):
                by_channel[name.removeprefix(REJECTED)] += count
    return found | {"by_channel": dict(sorted(by_channel.items()))}


def not_on_disk(totals: Collection[Totals]) -> Summary:
    """What the disk did not take, by name; all 0 where it took everything."""
    return {field: sum(total.counters[counter] for total in totals) for field, counter in NOT_ON_DISK.items()}


def _about(config: RunConfig, run: str) -> Summary:
    return {
        "schema": SCHEMA,
        "run": run,
        "preset": config.preset,
        "env": config.env.id,
        "env_count": config.env.count,
        "algo": config.learner.algo,
        "seed": config.seed,
        "tick_hz": config.env.hz,
        "unit_s": config.env.unit_s,
    }


def discrepancies(summary: Summary) -> list[str]:
    """What does not reconcile, each as an equation that fails; empty when everything does."""
    transitions, policies, agents = summary["transitions"], summary["policies"], summary.get("env_count", 1)
    pairs = [
        ("ticks = produced + resets", summary["ticks"], transitions["produced"] + summary["resets"]),
        ("produced = learned + lost", transitions["produced"], transitions["learned"] + transitions["lost"]),
        (
            ("published" if agents == 1 else f"published x {agents}")
            + " + received_again = "
            + " + ".join(FATES),
            agents * policies["published"] + policies["received_again"],
            sum(policies[name] for name in FATES),
        ),
        (
            "missed = sum of its causes",
            summary["deadlines"]["missed"],
            sum(summary["deadlines"]["missed_by_cause"].values()),
        ),
    ]
    failing = [f"{equation}: {left} != {right}" for equation, left, right in pairs if left != right]
    left_over = {"transitions.lost": transitions["lost"], "policies.unreceived": policies["unreceived"]}
    failing += [f"{name} >= 0: it is {count}" for name, count in left_over.items() if count < 0]
    return failing + fleet.discrepancies(summary)


def _deadlines(env: Totals) -> Summary:
    missed, ticks = env.counters["missed"], env.counters["ticks"]
    prefix = "missed."
    found = {name.removeprefix(prefix): n for name, n in env.counters.items() if name.startswith(prefix)}
    return {
        "missed": missed,
        "miss_ratio": missed / ticks if ticks else None,
        "overruns": env.counters["overruns"],
        "skipped": env.counters["skipped"],
        "down": env.counters["down"],
        "missed_by_cause": dict.fromkeys(CAUSES, 0) | found,
    }


def _policies(
    learner: Totals, agent: Totals, learners: Sequence[Stats], became: Sequence[Mapping[str, int]]
) -> Summary:
    """Every published policy has one of the `FATES` with each agent: `became` (`launcher.fates`). `foreign`
    ones were not the learner's, and have none. `learners` are the lives of the learner.
    """
    latency = agent.quantiles("publish_to_adopt", 1e-6)
    return {
        "published": learner.counters["published"],
        **{name: sum(one[name] for one in became) for name in (*FATES, "received_again")},
        "foreign": agent.counters["policies.foreign"],
        "published_in_hold": learner.counters["published_in_hold"],
        "withheld": learner.counters["withheld"],
        "last_version": max((life.counters.get("last_version", 0) for life in learners), default=0),
        "publish_to_adopt_ms": {name: latency[name] for name in ("p50", "p99", "max")},
    }


def _windows(notices: Iterable[WindowNotice]) -> list[Summary]:
    """One row per window; its phases, and operators' holds, are several notices."""
    rows = {
        one.window: {"m": one.window, "t_m": one.start_unit, "G": one.update_units, "N": one.hold_units}
        for one in notices
    }
    return [rows[window] for window in sorted(rows)]


def _transitions(env: Totals, learner: Totals) -> Summary:
    produced = env.counters["produced"]
    learned = learner.counters["learned"] - learner.counters["unread"]  # what never reached the table is lost
    return {
        "produced": produced,
        "learned": learned,
        "lost": produced - learned,
        "duplicate": learner.counters["duplicate"],
    }


def _learner(learner: Totals, run_time_s: float) -> Summary:
    steps = learner.counters["gradient_steps"]
    return {
        "gradient_steps": steps,
        "policy_steps": learner.counters["policy_steps"],
        "updates_per_s": steps / run_time_s if run_time_s else None,
        "governor": _governor(learner),
    }


def _governor(learner: Totals) -> Summary:
    """`limited_share`: of the time that was governed, with less than full power; None without a governor."""
    ticks, limited = learner.counters["governor.ticks"], learner.counters["governor.limited_ticks"]
    return {
        "decisions": learner.counters["governor.decisions"],
        "limited_share": limited / ticks if ticks else None,
    }


def passed(env: Totals) -> int:
    """Deadlines that one environment ticked through, skipped, or was without an env server at."""
    return sum(env.counters[name] for name in PASSED)


def _forecast(gauges: Mapping[str, float]) -> Summary:
    """Means over the windows judged, None where none was; `trust` is the share of the forecast at the end."""
    windows = gauges.get("forecast/windows")
    return {
        "windows": None if windows is None else int(windows),
        "error": gauges.get("forecast/error"),
        "baseline_error": gauges.get("forecast/baseline_error"),
        "trust": gauges.get("forecast/trust"),
    }
