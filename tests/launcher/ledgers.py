"""Hand-made ledgers of a small run: 200 ticks at 100 Hz, 2 resets, 3 misses, 4 policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from rtcore.channels import AGENT, ENV_SERVER, LEARNER, RECORDER
from rtcore.config import EnvConfig, RunConfig
from rtcore.histogram import Histogram
from rtcore.messages import EpisodeReturn, Event, Phase, Stats, WindowNotice

CONFIG = RunConfig(preset="pointmass", seed=4, duration_s=2.0, env=EnvConfig(id="pointmass", hz=100.0))


def ledger(
    process: str,
    *,
    incarnation: int = 1,
    seq: int = 0,
    at_ns: int = 0,
    final: bool = False,
    counters: dict[str, int] | None = None,
    gauges: dict[str, float] | None = None,
    histograms: Mapping[str, Sequence[int]] | None = None,
    returns: Sequence[EpisodeReturn] = (),
    windows: Sequence[WindowNotice] = (),
    events: Sequence[Event] = (),
    beat_ns: int = 0,
) -> Stats:
    return Stats(
        process=process,
        incarnation=incarnation,
        seq=seq,
        at_ns=at_ns,
        final=final,
        counters=counters or {},
        gauges=gauges or {},
        histograms={name: histogram(values).to_bytes() for name, values in (histograms or {}).items()},
        returns=list(returns),
        windows=list(windows),
        events=list(events),
        beat_ns=beat_ns,
    )


def histogram(values: Sequence[int]) -> Histogram:
    made = Histogram()
    for value in values:
        made.record(value)
    return made


def episode(index: int, value: float) -> EpisodeReturn:
    return EpisodeReturn(episode=index, at_ns=0, value=value, length=100)


def notice(window: int, phase: Phase, *, operator: bool = False) -> WindowNotice:
    return WindowNotice(
        window=window,
        start_unit=10 * window,
        update_units=7,
        hold_units=3,
        phase=phase,
        at_ns=0,
        reason="operator" if operator else "schedule",
    )


def env_ledger(*, seq: int = 0, at_ns: int = 0, final: bool = False) -> Stats:
    return ledger(
        ENV_SERVER,
        seq=seq,
        at_ns=at_ns,
        final=final,
        counters={
            "ticks": 200,
            "resets": 2,
            "produced": 198,
            "episodes": 2,
            "missed": 3,
            "missed.agent_late": 2,
            "missed.env_late": 1,
            "overruns": 1,
            "skipped": 50,
            "messages.rejected": 1,
            "messages.rejected.action": 1,
        },
        histograms={"pacing": [1_000, 1_000, 1_000, 9_000], "loop": [500_000]},
        returns=[episode(0, -30.0), episode(1, -10.0)],
    )


def agent_ledger() -> Stats:
    counters = {
        "policies.received": 3,
        "policies.adopted": 1,
        "policies.rejected": 1,
        "policies.superseded": 1,
        "messages.rejected": 2,
        "messages.rejected.policy": 1,
        "messages.rejected.action": 1,
    }
    return ledger(
        AGENT, counters=counters, histograms={"reaction": [80_000], "publish_to_adopt": [4_000_000]}
    )


def learner_ledger(*, hold: bool = True) -> Stats:
    windows = [notice(0, "update"), notice(0, "hold"), notice(1, "update")]
    if hold:
        windows += [notice(1, "hold", operator=True), notice(1, "update", operator=True)]
    return ledger(
        LEARNER,
        counters={
            "published": 4,
            "last_version": 4,
            "learned": 197,
            "duplicate": 5,
            "gradient_steps": 250,
            "operator_holds": int(hold),
            "policy_steps": 100,
        },
        gauges={"replay_size": 197.0},
        windows=windows,
    )


def recorder_ledger() -> Stats:
    return ledger(RECORDER, counters={"rows": 900, "dropped": 7})


def whole_run() -> dict[str, list[Stats]]:
    return {
        ENV_SERVER: [env_ledger()],
        AGENT: [agent_ledger()],
        LEARNER: [learner_ledger()],
        RECORDER: [recorder_ledger()],
    }


FLEET = RunConfig(
    preset="pointmass", seed=4, duration_s=2.0, env=EnvConfig(id="pointmass", hz=100.0, count=3)
)


def fleet_run() -> dict[str, list[Stats]]:
    """Three environments of 200, 100 and 50 ticks, agents that got 4, 3 and 4 of 4 policies, one learner:

    env0  200 ticks, 2 resets, 198 produced, 3 missed;   198 learned
    env1  100 ticks, 1 reset,   99 produced, 1 missed;    97 learned, 5 duplicate
    env2   50 ticks, 1 reset,   49 produced in two lives; 49 learned

    The agent of env2 was killed with policy 2 ready, and its second life began with policy 2 once more.
    """
    servers = [
        [env_ledger()],
        [
            ledger(
                "env_server.1",
                counters={
                    "ticks": 100, "resets": 1, "produced": 99, "episodes": 1, "missed": 1,
                    "missed.agent_absent": 1, "overruns": 0, "skipped": 0,
                },
                histograms={"pacing": [2_000], "loop": [700_000]},
                returns=[episode(0, -5.0)],
            )
        ],
        [
            ledger("env_server.2", incarnation=1, counters={"ticks": 30, "resets": 1, "produced": 29}),
            ledger(
                "env_server.2",
                incarnation=2,
                counters={"ticks": 20, "produced": 20, "down": 10, "episodes": 1},
                returns=[episode(1, 7.0)],
            ),
        ],
    ]  # fmt: skip
    servers[0][0] = msgspec.structs.replace(servers[0][0], process="env_server.0")
    agents = [
        [agent_life("agent_service.0", 1, first=1, newest=4, received=4, adopted=3, superseded=1)],
        [agent_life("agent_service.1", 1, first=1, newest=3, received=3, adopted=2, rejected=1)],
        [
            agent_life("agent_service.2", 1, final=False, first=1, newest=2, received=2, adopted=1),
            agent_life("agent_service.2", 2, first=2, newest=4, received=3, adopted=3),
        ],
    ]
    learner = learner_ledger()
    learner.counters.update(
        {
            "learned": 344, "learned.env0": 198, "learned.env1": 97, "learned.env2": 49,
            "duplicate": 5, "duplicate.env1": 5, "duplicate.env0": 0, "duplicate.env2": 0,
        }
    )  # fmt: skip
    found = {lives[0].process: lives for lives in (*servers, *agents)}
    return found | {LEARNER: [learner], RECORDER: [recorder_ledger()]}


def agent_life(
    process: str, incarnation: int, *, final: bool = True, first: int, newest: int, **fates: int
) -> Stats:
    """One life of an agent: which policies it got, and what became of them."""
    counters = {f"policies.{name}": count for name, count in fates.items()}
    counters |= {"policies.first": first, "policies.newest": newest}
    return ledger(
        process,
        incarnation=incarnation,
        final=final,
        counters=counters,
        gauges={"policy_version": float(newest)},
        histograms={"reaction": [80_000], "publish_to_adopt": [4_000_000]},
    )
