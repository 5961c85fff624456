"""A recorder's life through a whole run in virtual time, up to the instant at which kill -9 ends it.

python -m tests.recorder.killed_child DIR WHAT N ENVS: dies at its N-th write of `recording` or `place`, when
half of it is written; or of `recorded` or `placed`, when all of it is. WHAT = `never`: it lives. With several
environments the last one is some steps behind.
"""

from __future__ import annotations

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import msgspec

from rtcore import channels
from rtcore.cast import env_names
from rtcore.messages import Event, Step, StepBatch
from tests.recorder.stage import (
    CONFIG,
    SPEC,
    T0,
    TICK,
    UNIT,
    make_notice,
    make_policy,
    make_stats,
    make_step,
    set_stage,
)

STEPS = 400
FILES = {"recording": "recording.rrd", "recorded": "recording.rrd", "place": "recorder.place"}
FILES["placed"] = FILES["place"]


def main(directory: str, what: str, n: str, envs: str = "1") -> None:
    if what != "never":
        die_at(what, int(n))
    stage = set_stage(Path(directory), config=replace(CONFIG, env=replace(CONFIG.env, count=int(envs))))
    names = env_names(stage.config.env)
    for name in names:
        stage.bus.publisher(channels.SPEC, name).put(msgspec.structs.replace(SPEC, env=name))
    others = {name: stage.bus.publisher(channels.LOG, name) for name in names[1:]}
    for second in range(STEPS // 50):
        now = T0 + second * UNIT
        seqs = range(second * 50, second * 50 + 50)
        lines = [Event(at_ns=now - 45 * TICK + i, level="INFO", text=f"line {i}") for i in range(2)]
        gauges = {"loss/q": second / 8, "forecast/a": float(second), f"forecast/b{second // 3}": 0.5}
        windows = [make_notice(w, p, T0 + 3 * w * UNIT) for w in range(second // 3 + 1) for p in ("update",)]
        stage.policy.put(make_policy(second + 1, now + 5))
        stage.stats(make_stats("learner", second, now, events=lines, gauges=gauges, windows=windows))
        for i, (name, log) in enumerate(others.items()):
            behind = range(max(0, seqs.start - 3 * i), seqs.stop - 3 * i if seqs.stop < STEPS else STEPS)
            log.put(StepBatch(steps=[of_fleet(name, seq) for seq in behind]))
        stage.steps([make_step(seq, episode=seq // 75, episode_tick=seq % 75) for seq in seqs], size=10)
    stage.service.close()


def of_fleet(env: str, seq: int) -> Step:
    """A step that is not the first environment's."""
    return make_step(seq, env=env, episode=seq // 60, episode_tick=seq % 60, drift=0.5)


def die_at(what: str, n: int) -> None:
    """Have this process die; see the module."""
    pwrite, writes = os.pwrite, [0]

    def counted(file: int, data: bytes | memoryview, offset: int) -> int:
        if Path(f"/proc/self/fd/{file}").readlink().name == FILES[what]:
            writes[0] += 1
            if writes[0] == n:
                whole = what in ("recorded", "placed")
                pwrite(file, data if whole else data[: len(data) // 2], offset)
                os.kill(os.getpid(), signal.SIGKILL)
        return pwrite(file, data, offset)

    os.pwrite = counted  # type: ignore[assignment]


if __name__ == "__main__":
    main(*sys.argv[1:])
