"""Spares under a supervisor: one is the next life, and there are none to come at the end."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from launcher import spares
from launcher.restarts import Happening, Restarts
from launcher.supervisor import End, Interrupts, Supervisor
from rtcore.channels import AGENT
from tests.launcher.test_supervisor import children
from tests.launcher.test_supervisor_restarts import QUICK, pid


def with_spare(directory: Path, told: list[Happening]) -> Supervisor:
    """Four fakes; one that has waited notes its order in `order`, and never becomes the agent."""
    (directory / "spares").touch()
    wait = 'echo new >> "$0/spares"; read -r order; echo "$order" > "$0/order"; exec sleep 30'
    return Supervisor(
        children(directory, {}), directory, spares={AGENT: ["sh", "-c", wait, str(directory)]},
        restarts=Restarts(QUICK), tell=told.append,
    )  # fmt: skip


def test_a_spare_is_the_next_life(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spares, "SETTLED_S", 0.0)
    told: list[Happening] = []
    fakes = with_spare(tmp_path, told)
    interrupts, killed, limit_s = Interrupts(), False, time.monotonic() + 20

    def poll(waiting_for: frozenset[str]) -> None:
        nonlocal killed
        assert time.monotonic() < limit_s
        ready = (tmp_path / f"{AGENT}.ready").exists() and (tmp_path / "spares").read_text()
        if ready and not killed:
            killed = True
            os.kill(pid(tmp_path, AGENT), signal.SIGKILL)
        interrupts.count = int((tmp_path / "order").exists())

    with fakes.started():
        end = fakes.supervise(interrupts, poll)
    assert end == End("interrupted")
    assert [one.text for one in told] == [
        "agent_service died (signal SIGKILL); it is started again in 0.05 s",
        "agent_service is started again from its spare",
    ]
    assert "tests/launcher/children.py" in (tmp_path / "order").read_text()


def test_there_are_no_new_spares_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spares, "SETTLED_S", 0.0)
    fakes = with_spare(tmp_path, [])
    interrupts = Interrupts()
    interrupts.count = 1
    with fakes.started():
        fakes.supervise(interrupts, lambda waiting_for: time.sleep(0.05))
        time.sleep(0.05)
    assert (tmp_path / "spares").read_text() == ""
