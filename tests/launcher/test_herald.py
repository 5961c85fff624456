from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from launcher.herald import Herald, logged
from launcher.restarts import Happening
from recorder.intake import Intake
from recorder.telemetry import TelemetryRows
from rtcore import channels
from rtcore.bus import QueueReader
from rtcore.channels import AGENT, LAUNCHER, RECORDER
from rtcore.clock import VirtualClock
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Event, Stats, StepBatch

SECOND = 1_000_000_000
DIED = Happening(5, AGENT, "died", -9, "agent_service died (signal SIGKILL)")
AGAIN = Happening(6, AGENT, "restarted", None, "agent_service is started again")


class Stage:
    """A herald and somebody who listens."""

    def __init__(self) -> None:
        self.clock, self.hub = VirtualClock(SECOND), MemoryHub()
        self.herald = Herald(self.hub.bus("client", self.clock), self.clock, 7)
        self.heard: QueueReader[Stats] = self.hub.bus("client", self.clock).queue(channels.STATS, "*")

    def pulse(self, seconds: float) -> list[Stats]:
        for _ in range(round(seconds * 20)):
            self.herald.pulse()
            self.clock.advance_ns(SECOND // 20)
        return [received.message for received in self.heard.drain()]


def test_it_says_nothing_until_something_happens_and_then_at_once_and_on() -> None:
    stage = Stage()
    assert stage.pulse(5.0) == []
    for happening in (DIED, AGAIN):
        stage.herald.tell(happening)
    said = stage.pulse(1.0)
    assert len(said) == 4
    assert {(one.process, one.incarnation, one.final) for one in said} == {(LAUNCHER, 7, False)}
    assert said[0].counters == {"deaths": 1, "restarts": 1, "messages.rejected": 0}
    told = [Event(at_ns=5, level="WARN", text=DIED.text), Event(at_ns=6, level="INFO", text=AGAIN.text)]
    assert said[0].events == told
    assert stage.pulse(60.0)[-1].events == told  # for a recorder that was not there


def test_the_recorder_does_not_wait_for_its_last_words() -> None:
    stage = Stage()
    intake = Intake(stage.hub.bus(RECORDER, stage.clock), ("env0",), TelemetryRows())
    stage.hub.bus(channels.ENV_SERVER, stage.clock).publisher(channels.LOG, "env0").put(
        StepBatch(steps=[], last=True)
    )
    stage.herald.tell(DIED)
    stage.pulse(0.1)
    intake.take_steps("env0", stage.clock.now_ns())
    assert intake.take_telemetry() == 1
    assert intake.complete


def test_its_log_has_what_happened_and_stderr_has_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "launcher.jsonl"
    with logged(path):
        assert not path.exists()
        herald = Stage().herald
        herald.tell(DIED)
        herald.tell(AGAIN)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [(line["level"], line["text"]) for line in lines] == [("WARN", DIED.text), ("INFO", AGAIN.text)]
    assert capsys.readouterr().err == ""
    assert logging.getLogger(LAUNCHER).handlers == []


def test_a_full_disk_costs_its_log_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    with logged(Path("/dev/full")):
        Stage().herald.tell(DIED)
    assert "No space left on device" in capsys.readouterr().err
    assert logging.getLogger(LAUNCHER).handlers == []
