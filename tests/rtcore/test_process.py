"""What the processes share: threads that are missed when they die, and last words that are kept."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from rtcore import channels, process, realtime
from rtcore.bus import BusError
from rtcore.clock import VirtualClock
from rtcore.config import EnvConfig, RunConfig
from rtcore.ledger import Ledger, brief
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import EpisodeReturn
from rtcore.process import Reporter, _ledger, background
from rtcore.run_dir import RunDir


def test_a_thread_that_fails_stops_the_process_and_is_raised() -> None:
    ends = Stop()

    def loop(stop: Stop) -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"), background(loop, name="outbox", ends=ends):
        assert ends.wait(5.0)
    assert ends.reason == "thread outbox failed: disk full"


def test_a_thread_that_ends_in_order_raises_nothing() -> None:
    ends, seen = Stop(), []

    def loop(stop: Stop) -> None:
        seen.append(stop.wait(5.0))

    with background(loop, name="reporter", ends=ends):
        pass
    assert seen == [True]
    assert not ends.is_set()


def test_a_snapshot_that_cannot_be_sent_is_counted_and_whole() -> None:
    clock = VirtualClock(5)
    bus = MemoryHub().bus(channels.LEARNER, clock)
    ledger = Ledger(channels.LEARNER, 1)
    reporter = Reporter(ledger, bus, clock, channels.LEARNER)
    ledger.count("learned", 3)
    bus.close()
    last = reporter.snapshot(final=True)
    reporter.publish(last)
    assert last.counters["learned"] == 3
    assert ledger.counter("stats.unsent") == 1
    with pytest.raises(BusError):
        bus.publisher(channels.WINDOW).put(None)  # type: ignore[arg-type]


def test_a_run_directory_that_is_none_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "agent_service", "--run", str(tmp_path)],
        capture_output=True, text=True, timeout=30, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("agent_service: run_dir = ") and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_what_no_restart_changes_is_exit_code_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(role: str, argv: Sequence[str] | None) -> None:
        raise realtime.RealtimeError(role, [realtime.FIFO])

    monkeypatch.setattr(process, "open_process", refused)
    assert process.run_process(channels.AGENT, lambda opened: None) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_process_whose_parent_is_gone_ends_at_once(tmp_path: Path) -> None:
    run_dir = RunDir.create(tmp_path / "run", RunConfig(env=EnvConfig(id="pointmass", hz=50.0)))
    begin = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "agent_service", "--run", str(run_dir.path), "--supervised", "1"],
        timeout=30, check=False,
    )  # fmt: skip
    assert done.returncode != 0
    assert time.monotonic() - begin < 20


def test_what_was_rejected_is_counted_by_channel() -> None:
    clock, hub = VirtualClock(5), MemoryHub()
    bus, ledger = hub.bus(channels.LEARNER, clock), Ledger(channels.LEARNER, 1)
    queue = bus.queue(channels.LOG, "env")
    hub.inject(channels.LOG.key_for("env"), b"nonsense")
    assert queue.drain() == []
    last = Reporter(ledger, bus, clock, channels.LEARNER).snapshot()
    assert last.counters == {"messages.rejected": 1, "messages.rejected.log": 1}


def test_last_words_of_a_long_life_fit_into_a_message() -> None:
    clock, hub = VirtualClock(5), MemoryHub()
    bus, ledger = hub.bus(channels.ENV_SERVER, clock), Ledger(channels.ENV_SERVER, 1)
    stats = hub.bus(channels.RECORDER, clock).queue(channels.STATS, "*")
    for number in range(60_000):
        ledger.episode(EpisodeReturn(episode=number, at_ns=1 << 55, value=1.5, length=1000))
    reporter = Reporter(ledger, bus, clock, channels.ENV_SERVER)
    last = reporter.snapshot(final=True)
    assert len(last.returns) == 60_000
    reporter.publish(brief(last))
    (received,) = stats.drain()
    assert received.message.final and received.message.returns[-1].episode == 59_999
    assert ledger.counter("stats.unsent") == 0


def test_a_killed_process_leaves_its_counters_and_the_next_life_a_greater_number(tmp_path: Path) -> None:
    run_dir = RunDir.create(tmp_path / "run", RunConfig(env=EnvConfig(id="pointmass", hz=50.0)))
    lives: list[list[int]] = []
    for _ in range(2):
        command = [sys.executable, "-m", "agent_service", "--run", str(run_dir.path)]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as agent:
            begin = time.monotonic()
            while len(run_dir.read_final_stats()) == len(lives):
                assert time.monotonic() < begin + 20 and agent.poll() is None
                time.sleep(0.02)
            agent.kill()
        lives.append([stats.incarnation for stats in run_dir.read_final_stats()])
    run_dir.remove_socket_dir()
    assert lives[1] == sorted(lives[1]) and lives[1][:1] == lives[0] and len(set(lives[1])) == 2
    assert [stats.final for stats in run_dir.read_final_stats()] == [False, False]


def test_without_a_place_for_its_tally_a_process_lives_and_says_so(tmp_path: Path) -> None:
    run_dir = RunDir(tmp_path / "none")
    with _ledger(run_dir, channels.LEARNER, 1, VirtualClock(5)) as ledger:
        ledger.count("learned")
        stats = ledger.stats(6)
    assert stats.counters == {"tally.unbacked": 1, "learned": 1}
    assert [event.level for event in stats.events] == ["WARN"]
