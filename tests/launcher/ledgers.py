"""Hand-made ledgers of a small run: 200 ticks at 100 Hz, 2 resets, 3 misses, 4 policies."""

from __future__ import annotations

from collections.abc import Sequence

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
    histograms: dict[str, Sequence[int]] | None = None,
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
