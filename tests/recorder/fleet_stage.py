"""A stage with several env servers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from recorder import reading
from rtcore import channels
from rtcore.bus import Publisher
from rtcore.messages import Step, StepBatch
from tests.recorder.stage import CONFIG, MS, SPEC, T0, TICK, Stage, make_step, set_stage


@dataclass
class Fleet:
    """The env servers of a stage's run."""

    stage: Stage

    def __post_init__(self) -> None:
        self._logs: dict[str, Publisher[StepBatch]] = {}

    def declare(self, *envs: str, **changes: Any) -> None:
        for env in envs:
            spec = msgspec.structs.replace(SPEC, env=env, **changes)
            self.stage.bus.publisher(channels.SPEC, env).put(spec)

    def send(self, env: str, steps: Sequence[Step], *, last: bool = False) -> None:
        if env not in self._logs:
            self._logs[env] = self.stage.bus.publisher(channels.LOG, env)
        own = [msgspec.structs.replace(step, env=env) for step in steps]
        self._logs[env].put(StepBatch(steps=own, last=last))

    def play(self, seqs: range, *envs: str, size: int = 10, last: bool = False) -> None:
        """All envs tick together; the reward tells them apart, and so do the episodes: env1's are longer."""
        for begin in range(seqs.start, seqs.stop, size):
            part = range(begin, min(begin + size, seqs.stop))
            self.stage.clock.sleep_until_ns(T0 + part[-1] * TICK + MS)
            for env in envs:
                self.send(env, [tick_of(env, seq) for seq in part], last=last and part.stop == seqs.stop)
            self.stage.service.poll()


def tick_of(env: str, seq: int) -> Step:
    number = int(env[-1])
    length = 10 + 5 * number
    return make_step(
        seq,
        episode=seq // length,
        episode_tick=seq % length,
        truncated=seq % length == length - 1,
        reward=0.0 if seq % length == 0 else 100.0 * number + seq,
        position=np.array([0.1 * seq + number], "<f8").tobytes(),
    )


def set_fleet(tmp_path: Path, count: int = 2) -> Fleet:
    return Fleet(set_stage(tmp_path, config=replace(CONFIG, env=replace(CONFIG.env, count=count))))


def ticks(stage: Stage, env: str) -> list[int]:
    found: list[int] = reading.columns(stage.path, f"/{env}/env/reward")[0].tolist()
    return found
