"""Evidence of runs under faults, made up by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from launcher.chaos.clause import Clause
from launcher.chaos.evidence import Evidence, Life, Recorded
from launcher.chaos.faults import Done
from launcher.chaos.judge import judge
from launcher.chaos.plan import Fault
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER

KILLED, STOPPED = Fault(10.0, LEARNER, "kill"), Fault(20.0, AGENT, "stop", 2.0)
ENV_KILLED = Fault(30.0, ENV_SERVER, "kill")
FAULTS = (KILLED, STOPPED, ENV_KILLED)

# 40 s at 100 Hz: 4000 deadlines. The env server dies after tick 2999 and is back for tick 3050; it lost 3
# deadlines before, at ticks 500 to 502. Its last 2 ticks never reached anybody.
FIRST = {"lives": 1, "ticks": 2997, "resets": 30, "produced": 2967, "skipped": 3, "down": 0}
SECOND = {"lives": 1, "ticks": 950, "resets": 10, "produced": 940, "skipped": 0, "down": 50}
LEARNERS = ({"learned": 1000, "last_version": 4, "published": 4}, {"learned": 2905, "last_version": 9})
TICKS = np.array([tick for tick in range(4000) if tick not in (500, 501, 502) and not 2998 <= tick < 3050])


def summary(**changes: Any) -> dict[str, Any]:
    """One whose counts reconcile."""
    return {
        "ended": "duration",
        "forced": [],
        "ticks": 3947,
        "resets": 40,
        "deadlines": {"missed": 0, "missed_by_cause": {}},
        "policies": {
            "published": 9, "received_again": 1, "adopted": 10, "rejected": 0, "superseded": 0, "unused": 0,
            "unreceived": 0,
        },
        "transitions": {"produced": 3907, "learned": 3905, "lost": 2},
        "restarts": dict.fromkeys(PROCESSES, 0) | {LEARNER: 1, ENV_SERVER: 1},
        "supervision": [
            {"at_s": 10.0, "process": LEARNER, "what": "died", "code": -9},
            {"at_s": 10.1, "process": LEARNER, "what": "restarted", "code": None},
            {"at_s": 30.0, "process": ENV_SERVER, "what": "died", "code": -9},
            {"at_s": 30.1, "process": ENV_SERVER, "what": "restarted", "code": None},
        ],
    } | changes  # fmt: skip


def recorded(ticks: np.ndarray[Any, np.dtype[np.int64]] = TICKS, **changes: Any) -> Recorded:
    """Woken after 50 us, 60 beside others' faults."""
    shape = {
        "ticks": ticks,
        "pacing_us": np.full(len(ticks), 50.0),
        "acted": np.repeat([0, 3, 5, 9], [50, 100, 100, 100]),
        "published": np.arange(1, 10),
    }
    return Recorded(**(shape | changes))


def evidence(
    env: Sequence[Mapping[str, int]] = (FIRST, SECOND),
    learner: Sequence[Mapping[str, int]] = LEARNERS,
    recorder: Mapping[str, int] | None = None,
    **changes: Any,
) -> Evidence:
    """A run that kept every promise."""
    lives = {
        ENV_SERVER: [Life(counters, i == len(env) - 1) for i, counters in enumerate(env)],
        AGENT: [Life({"policies.adopted": 10}, True)],
        LEARNER: [Life(counters, i == len(learner) - 1) for i, counters in enumerate(learner)],
        RECORDER: [Life(recorder or {}, True)],
    }
    whole = Evidence(
        done=[Done(fault, fault.at_s) for fault in FAULTS],
        ended=True,
        tick_s=0.01,
        num_ticks=4000,
        summary=summary(),
        lives=lives,
        recorded=recorded(),
        kept=3905,
    )
    return replace(whole, **changes)


def verdict(name: str, found: Evidence) -> Clause:
    return next(clause for clause in judge(found) if clause.name == name)
