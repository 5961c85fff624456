"""What comes at once after a restart is all taken in, and meanwhile the recorder shows that it lives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from recorder.intake import Intake
from recorder.telemetry import TelemetryRows
from recorder.ticks import TickRows
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.log_reader import LogReader
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Step, StepBatch
from rtcore.zenoh_senders import LOSSLESS_CACHE
from tests.recorder.fleet_stage import set_fleet, tick_of, ticks
from tests.recorder.stage import SPEC, T0, UNIT, make_step


@pytest.mark.parametrize("count", [1, 5])
def test_the_history_of_each_environment_has_room_with_what_comes_meanwhile(count: int) -> None:
    clock, hub, envs = VirtualClock(T0 + 100 * UNIT), MemoryHub(), [f"env{i}" for i in range(count)]
    others, bus = hub.bus("others", clock), hub.bus(channels.RECORDER, clock)
    logs = {env: others.publisher(channels.LOG, env) for env in envs}

    def send(begin: int, end: int) -> None:
        for env, log in logs.items():
            for seq in range(begin, end):
                log.put(StepBatch(steps=[make_step(seq, env=env)]))

    for env in envs:
        others.publisher(channels.SPEC, env).put(msgspec.structs.replace(SPEC, env=env))
    send(0, LOSSLESS_CACHE)
    intake = Intake(bus, envs, TelemetryRows())
    send(LOSSLESS_CACHE, LOSSLESS_CACHE + 400)  # 20 s until it reads for the first time
    for env in envs:
        taken = [step.seq for step in intake.take_steps(env, clock.now_ns())]
        assert taken == list(range(LOSSLESS_CACHE + 400)), env
    assert intake.dropped == bus.rejected().get(channels.LOG.name, 0) == 0


def test_between_two_beats_lies_one_history_or_so_many_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = set_fleet(tmp_path, 4)
    stage, envs = fleet.stage, [f"env{i}" for i in range(4)]
    beats: list[int] = []
    read, rows = LogReader.read, TickRows.rows

    def slow_read(log: LogReader, now_ns: int) -> list[Step]:
        stage.clock.advance_ns(5 * UNIT)
        return read(log, now_ns)

    def slow_rows(ticks: TickRows, steps: Sequence[Step]) -> Any:
        stage.clock.advance_ns(len(steps) * UNIT // 5)
        return rows(ticks, steps)

    fleet.declare(*envs)
    counts = dict(zip(envs, (15, 15, 15, 70), strict=True))  # the last one alone has more than a piece
    for env, count in counts.items():
        fleet.send(env, [tick_of(env, seq) for seq in range(count)])
    monkeypatch.setattr("recorder.service.MAX_ROWS", 20)
    monkeypatch.setattr("recorder.service.finish", lambda *_, **__: None)
    monkeypatch.setattr(LogReader, "read", slow_read)
    monkeypatch.setattr(TickRows, "rows", slow_rows)
    monkeypatch.setattr(stage.ledger, "beat", beats.append)
    stage.service.poll()
    stage.service.flush()
    assert np.diff([*beats, stage.clock.now_ns()]).max() == 5 * UNIT  # not 20 s of reading, 14 s of writing
    stage.service.close()
    assert {env: ticks(stage, env) for env in envs} == {env: list(range(n)) for env, n in counts.items()}
