"""`summary.json`: what a run did, from its configuration and the ledgers of its processes. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any, Literal

from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER
from rtcore.config import RunConfig
from rtcore.histogram import Histogram
from rtcore.messages import CAUSES, Stats, WindowNotice

SCHEMA = 1
FATES = ("adopted", "rejected", "superseded", "unused", "unreceived")  # of a published policy
REJECTED = "messages.rejected."  # begins the counters of each channel
PASSED = ("ticks", "skipped", "down")  # every deadline from T0 on is one of them

Summary = dict[str, Any]
StatsByProcess = Mapping[str, Sequence[Stats]]  # per process: the newest ledger of each incarnation


@dataclass
class Totals:
    """One process's ledgers, added up over its incarnations."""

    counters: Counter[str] = field(default_factory=Counter)
    gauges: dict[str, float] = field(default_factory=dict)  # of the newest incarnation that has them
    histograms: dict[str, Histogram] = field(default_factory=dict)
    returns: list[float] = field(default_factory=list)  # in the order of the episodes
    windows: list[WindowNotice] = field(default_factory=list)

    def quantiles(self, name: str, scale: float) -> dict[str, float | None]:
        """{p50, p99, p999, max} of a histogram in ns, times `scale`; None where nothing was recorded."""
        return self.histograms.get(name, Histogram()).summary(scale)


def add_up(incarnations: Sequence[Stats]) -> Totals:
    """One process's totals."""
    total = Totals()
    for ledger in sorted(incarnations, key=lambda one: one.incarnation):
        total.counters.update(ledger.counters)
        total.gauges.update(ledger.gauges)
        total.windows.extend(ledger.windows)
        total.returns.extend(one.value for one in sorted(ledger.returns, key=lambda one: one.episode))
        for name, data in ledger.histograms.items():
            total.histograms.setdefault(name, Histogram()).merge(Histogram.from_bytes(data))
    return total


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
        stats: every process's ledgers; a process may be absent.
        wall_s: seconds from the start of the first process to the end of the last.
        restarts: how often each process was started again.
        ended: why the run ended, in a few words.
        forced: processes that had to be killed at the end.
        clock: what the run went by.
    """
    totals = {process: add_up(stats.get(process, ())) for process in PROCESSES}
    env, learner, recorder = totals[ENV_SERVER], totals[LEARNER], totals[RECORDER]
    ticks = env.counters["ticks"]
    return {
        **_about(config, run),
        "wall_s": wall_s,
        "clock": clock,
        "ended": ended,
        "forced": list(forced),
        "ticks": ticks,
        "resets": env.counters["resets"],
        "episodes": env.counters["episodes"],
        "mean_return": fmean(env.returns) if env.returns else None,
        "returns": env.returns,
        "deadlines": _deadlines(env),
        "pacing_error_us": env.quantiles("pacing", 1e-3),
        "reaction_us": totals[AGENT].quantiles("reaction", 1e-3),
        "loop_us": env.quantiles("loop", 1e-3),
        "policies": _policies(learner, totals[AGENT], stats),
        "windows": _windows(learner.windows),
        "operator_holds": learner.counters["operator_holds"],
        "transitions": _transitions(env, learner),
        "learner": _learner(learner, _run_time_s(env, config)),
        "forecast": _forecast(learner.gauges),
        "recorder": {"rows": recorder.counters["rows"], "dropped": recorder.counters["dropped"]},
        "restarts": {process: restarts.get(process, 0) for process in PROCESSES},
        "supervision": [],
        "messages": _messages(totals.values()),
    }


def _messages(totals: Collection[Totals]) -> Summary:
    """What came and was not taken: `rejected` for what it was, also by channel, `denied` for whom it was
    from, by access control; and the links that secured processes refused.
    """
    counted = {"rejected": "messages.rejected", "denied": "link.denied", "links_refused": "link.refused"}
    found: Summary = {
        name: sum(total.counters[counter] for total in totals) for name, counter in counted.items()
    }
    by_channel: Counter[str] = Counter()
    for total in totals:
        for name, count in total.counters.items():
            if name.startswith(REJECTED):
                by_channel[name.removeprefix(REJECTED)] += count
    return found | {"by_channel": dict(sorted(by_channel.items()))}


def _about(config: RunConfig, run: str) -> Summary:
    return {
        "schema": SCHEMA,
        "run": run,
        "preset": config.preset,
        "env": config.env.id,
        "algo": config.learner.algo,
        "seed": config.seed,
        "tick_hz": config.env.hz,
        "unit_s": config.env.unit_s,
    }


def discrepancies(summary: Summary) -> list[str]:
    """What does not reconcile, each as an equation that fails; empty when everything does."""
    transitions, policies = summary["transitions"], summary["policies"]
    fates = sum(policies[name] for name in FATES)
    pairs = [
        ("ticks = produced + resets", summary["ticks"], transitions["produced"] + summary["resets"]),
        ("produced = learned + lost", transitions["produced"], transitions["learned"] + transitions["lost"]),
        (
            "published + received_again = " + " + ".join(FATES),
            policies["published"] + policies["received_again"],
            fates,
        ),
        (
            "missed = sum of its causes",
            summary["deadlines"]["missed"],
            sum(summary["deadlines"]["missed_by_cause"].values()),
        ),
    ]
    failing = [f"{equation}: {left} != {right}" for equation, left, right in pairs if left != right]
    left_over = {"transitions.lost": transitions["lost"], "policies.unreceived": policies["unreceived"]}
    return failing + [f"{name} >= 0: it is {count}" for name, count in left_over.items() if count < 0]


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


def _policies(learner: Totals, agent: Totals, stats: StatsByProcess) -> Summary:
    """Every published policy has one of the `FATES`. `unused`: ready when the agent ended, or died;
    `unreceived`: no agent lived to get it. The last one of a run often has one of these two.

    What the agent got once more has a fate once more, `received_again` of them: the newest one after it was
    started again, and older ones, which it rejects. `foreign` ones were not the learner's, and have none.
    """
    published, received = learner.counters["published"], agent.counters["policies.received"]
    again = _received_again(stats.get(AGENT, ()))
    latency = agent.quantiles("publish_to_adopt", 1e-6)
    return {
        "published": published,
        "adopted": agent.counters["policies.adopted"],
        "rejected": agent.counters["policies.rejected"],
        "superseded": agent.counters["policies.superseded"],
        "unused": agent.counters["policies.unused"] + _died_with_a_policy(stats.get(AGENT, ())),
        "unreceived": published - (received - again),
        "received_again": again,
        "foreign": agent.counters["policies.foreign"],
        "published_in_hold": learner.counters["published_in_hold"],
        "withheld": learner.counters["withheld"],
        "last_version": max(
            (life.counters.get("last_version", 0) for life in stats.get(LEARNER, ())), default=0
        ),
        "publish_to_adopt_ms": {name: latency[name] for name in ("p50", "p99", "max")},
    }


def _died_with_a_policy(lives: Iterable[Stats]) -> int:
    """Policies received by a life of the agent that was killed before it could say what became of them."""
    killed = [Counter(life.counters) for life in lives if not life.final]
    known = ("adopted", "rejected", "superseded", "unused")
    return sum(
        max(0, counters["policies.received"] - sum(counters[f"policies.{fate}"] for fate in known))
        for counters in killed
    )


def _received_again(lives: Iterable[Stats]) -> int:
    """Policies that were there before: older than the newest, or what a life of the agent began with and an
    earlier one had.
    """
    newest = again = 0
    for life in sorted(lives, key=lambda one: one.incarnation):
        first = life.counters.get("policies.first", 0)
        again += (0 < first <= newest) + life.counters.get("policies.past", 0)
        newest = max(newest, life.counters.get("policies.newest", 0))
    return again


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


def _run_time_s(env: Totals, config: RunConfig) -> float:
    """Seconds of run time that were ticked through, skipped, or without an env server."""
    return sum(env.counters[name] for name in PASSED) / config.env.hz if config.env.hz else 0.0


def _forecast(gauges: Mapping[str, float]) -> Summary:
    """Means over the windows judged, None where none was; `trust` is the share of the forecast at the end."""
    windows = gauges.get("forecast/windows")
    return {
        "windows": None if windows is None else int(windows),
        "error": gauges.get("forecast/error"),
        "baseline_error": gauges.get("forecast/baseline_error"),
        "trust": gauges.get("forecast/trust"),
    }
