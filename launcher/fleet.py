"""A fleet's `summary.json`: what each environment did, beside the totals. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import fmean
from typing import Any

from launcher.totals import Totals
from rtcore import cast
from rtcore.channels import AGENT, ENV_SERVER, LEARNER
from rtcore.config import RunConfig

Rows = dict[str, dict[str, Any]]

# What adds up over the environments, by the section of the summary that has the total.
TOTALS = {
    "": ("ticks", "resets", "episodes"),
    "deadlines": ("missed", "overruns", "skipped", "down"),
    "transitions": ("produced", "duplicate"),
    "policies": ("adopted", "unreceived"),
}


def rows(
    config: RunConfig,
    processes: Mapping[str, Totals],
    fates: Mapping[str, Mapping[str, int]],
    restarts: Mapping[str, int],
) -> Rows:
    """Each environment's row, by its name.

    Args:
        config: of a fleet.
        processes: everybody's totals, by the name of the process.
        fates: of the published policies, by the agent's name.
        restarts: how often each process was started again.
    """
    found: Rows = {}
    servers, agents = cast.of_role(config, ENV_SERVER), cast.of_role(config, AGENT)
    for name, server, agent in zip(cast.env_names(config.env), servers, agents, strict=True):
        env, learned = processes[server], processes[LEARNER].counters[f"learned.{name}"]
        ticks, missed, produced = (env.counters[one] for one in ("ticks", "missed", "produced"))
        found[name] = {
            "ticks": ticks,
            "resets": env.counters["resets"],
            "episodes": env.counters["episodes"],
            "mean_return": fmean(env.returns) if env.returns else None,
            "missed": missed,
            "miss_ratio": missed / ticks if ticks else None,
            "overruns": env.counters["overruns"],
            "skipped": env.counters["skipped"],
            "down": env.counters["down"],
            "produced": produced,
            "learned": learned,
            "lost": produced - learned,
            "duplicate": processes[LEARNER].counters[f"duplicate.{name}"],
            "adopted": fates[agent]["adopted"],
            "unreceived": fates[agent]["unreceived"],
            "restarts": {ENV_SERVER: restarts.get(server, 0), AGENT: restarts.get(agent, 0)},
        }
    return found


def discrepancies(summary: Mapping[str, Any]) -> list[str]:
    """What does not reconcile of each environment, or of them and the totals; each an equation that fails."""
    envs: Rows = summary.get("envs", {})
    if not envs:
        return []
    failing = []
    for name, row in envs.items():
        pairs = [
            ("ticks = produced + resets", row["ticks"], row["produced"] + row["resets"]),
            ("produced = learned + lost", row["produced"], row["learned"] + row["lost"]),
        ]
        failing += [
            f"{name}: {equation}: {left} != {right}" for equation, left, right in pairs if left != right
        ]
        negative = [one for one in ("lost", "unreceived") if row[one] < 0]
        failing += [f"{name}: {one} >= 0: it is {row[one]}" for one in negative]
    for what, (total, added) in _sums(summary, envs).items():
        if total != added:
            failing.append(f"{what} = sum over the environments: {total} != {added}")
    return failing


def _sums(summary: Mapping[str, Any], envs: Rows) -> dict[str, tuple[int, int]]:
    """(total, sum of the rows) of each."""
    found = {}
    for section, names in TOTALS.items():
        where = summary[section] if section else summary
        for name in names:
            found[name] = where[name], sum(row[name] for row in envs.values())
    # What was in the replay and never reached a table is known of the learner alone, of no environment.
    transitions = summary["transitions"]
    learned = transitions["learned"] + transitions["unread"]
    found["learned + unread"] = learned, sum(row["learned"] for row in envs.values())
    for role in (ENV_SERVER, AGENT):
        added = sum(row["restarts"][role] for row in envs.values())
        found[f"restarts of {role}"] = summary["restarts"][role], added
    return found
