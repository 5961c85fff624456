from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from launcher import report
from launcher.restarts import Happening
from launcher.screen import Screen
from launcher.summary import summarise
from launcher.watch import Watch
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, RECORDER
from rtcore.clock import VirtualClock
from rtcore.config import RecorderConfig, RunConfig
from rtcore.messages import Event
from rtcore.run_dir import RunDir
from tests.launcher.ledgers import (
    CONFIG,
    agent_ledger,
    env_ledger,
    learner_ledger,
    ledger,
    recorder_ledger,
    whole_run,
)

SECOND = 1_000_000_000
TERMINAL_LINES = 24


def console_of(width: int) -> tuple[Console, io.StringIO]:
    file = io.StringIO()
    return Console(file=file, width=width, height=TERMINAL_LINES, color_system=None), file


def watched() -> Watch:
    watch = Watch(100.0)
    for seq, ticks in enumerate((0, 25, 50)):
        stats = ledger(ENV_SERVER, seq=seq, at_ns=seq * SECOND // 4, counters={"ticks": ticks})
        watch.feed(stats, stats.at_ns)
    whole = env_ledger(seq=3, at_ns=2 * SECOND)
    event = Event(at_ns=0, level="WARN", text="policy 3 refused: NaN")
    watch.feed(ledger(LEARNER, seq=0, events=[event]), 2 * SECOND)
    for stats in (whole, agent_ledger(), learner_ledger(hold=False), recorder_ledger()):
        watch.feed(stats, 2 * SECOND)
    return watch


def screen_of(
    watch: Watch, width: int = 100, config: RunConfig = CONFIG
) -> tuple[Screen, io.StringIO, Console]:
    console, file = console_of(width)
    return Screen(console, config, "r1", watch, VirtualClock(2 * SECOND)), file, console


@pytest.mark.parametrize("width", [80, 100, 160])
def test_the_screen_fits_and_says_what_matters(width: int) -> None:
    screen, file, console = screen_of(watched(), width)
    console.print(screen.render())
    shown = file.getvalue()
    assert len(shown.splitlines()) < TERMINAL_LINES
    assert max(len(line) for line in shown.splitlines()) <= width
    for words in (
        "tenuto  r1",
        "0:02 / 0:02",
        "env_server",
        "100.0 of 100.0 Hz",
        "3  (1.50 %)",
        "window 1, update 1 of 7",
        "4 published, 1 adopted",
        "197 transitions",
        "250",
        "▁█  last -10.0   best -10.0",
        "policy 3 refused: NaN",
    ):
        assert words in shown, words


def test_the_screen_before_anything_came() -> None:
    screen, file, console = screen_of(Watch(100.0))
    console.print(screen.render())
    assert "● starting" in file.getvalue()
    assert "before the first window" in file.getvalue()
    assert screen.line().startswith("starting: env_server starting, agent_service starting")


def test_a_run_without_recorder_does_not_wait_for_one() -> None:
    screen, file, console = screen_of(
        watched(), config=replace(CONFIG, recorder=RecorderConfig(record=False))
    )
    console.print(screen.render())
    assert "recorder" not in file.getvalue()


def test_who_is_between_two_lives_and_how_often() -> None:
    watch = watched()
    for what in ("died", "restarted", "died", "restarted", "died"):
        watch.happened(Happening(5, LEARNER, what, None, what))
    watch.happened(Happening(6, AGENT, "stuck", -9, "hung"))
    watch.happened(Happening(6, AGENT, "restarted", None, "again"))
    screen, file, console = screen_of(watch)
    console.print(screen.render())
    shown = [line for line in file.getvalue().splitlines() if "●" in line]
    rows = {name: line for line in shown for name in (LEARNER, AGENT) if name in line}
    assert "● down" in rows[LEARNER] and "↻ 2" in rows[LEARNER]
    assert "● starting" in rows[AGENT] and "↻ 1" in rows[AGENT]
    assert screen.line().endswith("agent_service starting  learner down  restarts 3")


def test_what_is_not_on_disk_is_on_the_line() -> None:
    watch = watched()
    assert "not on disk" not in screen_of(watch)[0].line()
    watch.feed(
        ledger(LEARNER, incarnation=2, counters={"replay.unbacked": 40, "tally.unbacked": 1}), 2 * SECOND
    )
    watch.feed(ledger(RECORDER, incarnation=2, counters={"disk_dropped": 5}), 2 * SECOND)
    assert screen_of(watch)[0].line().endswith("  not on disk 46")


def test_without_a_terminal_it_is_a_line_every_five_seconds() -> None:
    console, file = console_of(100)
    clock = VirtualClock(2 * SECOND)
    screen = Screen(console, CONFIG, "r1", watched(), clock)
    with screen.shown():
        for _ in range(101):  # ten seconds
            screen.update()
            clock.advance_ns(SECOND // 10)
    lines = file.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[0].startswith(
        "0:02  100.0 Hz  missed 3  loop p99 500 µs  window 1, update 1 of 7  policy 4/1"
    )
    assert "env_server late" in lines[1]  # nothing more came


def test_a_terminal_is_drawn_four_times_a_second() -> None:
    file = io.StringIO()
    console = Console(file=file, width=100, height=TERMINAL_LINES, force_terminal=True)
    clock = VirtualClock(2 * SECOND)
    screen = Screen(console, CONFIG, "r1", watched(), clock)
    with screen.shown():
        for _ in range(100):  # one second
            screen.update()
            clock.advance_ns(SECOND // 100)
    assert file.getvalue().count("4 published") == 4 + 1  # once more while it is taken down


@pytest.mark.parametrize("width", [80, 100])
def test_the_report_fits_one_screen(width: int, tmp_path: Path) -> None:
    console, file = console_of(width)
    run_dir = RunDir.create(tmp_path / "r1", CONFIG)
    run_dir.recording_path.write_bytes(b"")
    summary = summarise(CONFIG, "r1", whole_run(), wall_s=125.0, restarts={}, ended="duration")
    console.print(report.render(summary, run_dir))
    shown = file.getvalue()
    assert len(shown.splitlines()) <= TERMINAL_LINES
    for words in (
        "200 at 100.0 Hz",
        "3  (1.50 %)",
        "2 agent_late, 1 env_late",
        "after 2:05: duration",
        "198 produced, 197 learned, 1 lost, 5 duplicate",
        "4 published, 1 adopted, 0 in a hold",
        "2 (G 7 N 3)",
        "900 rows, 7 dropped; 3 messages rejected",
        "reconcile",
        "tenuto view",
    ):
        assert words in shown, words


def test_the_report_says_loudly_what_is_wrong(tmp_path: Path) -> None:
    console, file = console_of(100)
    env, agent = env_ledger(), agent_ledger()
    env.counters["ticks"] = 300
    agent.counters["policies.foreign"] = 2
    agent.counters["policy_file.errors"] = 3
    summary = summarise(
        CONFIG,
        "r1",
        {**whole_run(), ENV_SERVER: [env], AGENT: [agent]},
        wall_s=1.0,
        restarts={LEARNER: 2},
        ended="learner ended unexpectedly (exit code 3)",
        forced=["recorder"],
    )
    console.print(report.render(summary, RunDir(tmp_path)))
    shown = file.getvalue()
    for words in (
        "ticks = produced + resets: 300 != 200",
        "2 policies that are not the learner's",
        "3 policies",
        "not on disk",
        "learner 2",
        "recorder did not end in time",
        "learner ended unexpectedly (exit code 3)",
    ):
        assert words in shown
    assert "tenuto view" not in shown  # there is no recording
