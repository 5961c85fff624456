"""A fleet's live screen and report, as text."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from launcher import report
from launcher.fleet_screen import Layout, layout, told
from launcher.restarts import Happening
from launcher.screen import Screen
from launcher.summary import summarise
from launcher.watch import Watch
from rtcore.channels import LEARNER, RECORDER
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.messages import Event
from rtcore.run_dir import RunDir
from tests.launcher.ledgers import FLEET, episode, fleet_run, ledger, notice

SECOND = 1_000_000_000


def fleet_of(count: int) -> RunConfig:
    return replace(FLEET, env=replace(FLEET.env, count=count))


def watched(count: int) -> Watch:
    """Two seconds at 100 Hz; environment i missed i ticks, its loop takes i + 1 ms, its last return is -i."""
    watch = Watch(100.0)
    for quarter in range(9):
        at_ns, ticks = quarter * SECOND // 4, 25 * quarter
        for i in range(count):
            counters = {"ticks": ticks, "missed": i, "missed.agent_late": i}
            loop, returns = {"loop": [1_000_000 * (i + 1)]}, [episode(0, -1000.0), episode(1, -float(i))]
            watch.feed(
                ledger(f"env_server.{i}", seq=quarter, at_ns=at_ns, counters=counters, histograms=loop,
                       returns=returns),
                at_ns,
            )  # fmt: skip
            agent = {"actions": ticks, "policies.adopted": 4 + (i == 0)}
            gauges = {"policy_version": 10.0 + i}
            watch.feed(
                ledger(f"agent_service.{i}", seq=quarter, at_ns=at_ns, counters=agent, gauges=gauges), at_ns
            )
        events = [Event(at_ns=at_ns, level="INFO", text=f"line {quarter}")]
        learner = {"published": 7, "gradient_steps": 50 * quarter}
        watch.feed(
            ledger(LEARNER, seq=quarter, at_ns=at_ns, counters=learner, windows=[notice(0, "update")],
                   events=events),
            at_ns,
        )  # fmt: skip
        watch.feed(ledger(RECORDER, seq=quarter, at_ns=at_ns, counters={"rows": 90 * quarter}), at_ns)
    return watch


def shown(count: int, width: int = 80, height: int = 24, watch: Watch | None = None) -> tuple[list[str], str]:
    """The screen's lines, and the one line without a terminal."""
    file = io.StringIO()
    console = Console(file=file, width=width, height=height, color_system=None)
    screen = Screen(console, fleet_of(count), "r1", watch or watched(count), VirtualClock(2 * SECOND))
    console.print(screen.render())
    return file.getvalue().splitlines(), screen.line()


@pytest.mark.parametrize("width", [80, 100, 160])
def test_four_environments_fit_a_small_terminal_with_all_that_matters(width: int) -> None:
    lines, _ = shown(4, width)
    assert len(lines) < 24
    assert max(map(len, lines)) <= width
    assert "…" not in "".join(lines)
    screen = "\n".join(lines)
    for words in (
        "0:02 / 0:02",
        "400.0 ticks/s",
        "400.0 actions/s",
        "200.0 updates/s",
        "7 published, 17 adopted",
        "6 agent_late",
        "line 8",
    ):
        assert words in screen, words
    (row,) = [line.split() for line in lines if "env2 " in line]
    assert row[1:12] == ["env2", "●", "alive", "100.0", "2", "(1.00", "%)", "3,000", "12", "-2.0", row[11]]
    (row,) = [line.split() for line in lines if "env0 " in line]
    assert row[8] == "1,000"  # its own, though the total's is made of it
    (total,) = [line.split() for line in lines if " all " in line]
    # 6 of 800 ticks were missed; the mean of the last returns is that of 0, -1, -2, -3.
    assert total[1:9] == ["all", "400.0", "6", "(0.75", "%)", "4,000", "7", "-1.5"]


@pytest.mark.parametrize(("width", "height"), [(80, 24), (80, 40), (120, 50)])
def test_sixteen_fit_too(width: int, height: int) -> None:
    lines, _ = shown(16, width, height)
    assert len(lines) < height
    for i in range(16):
        assert any(f"env{i} " in line for line in lines)
    assert any("1,600.0" in line for line in lines)
    assert ("line 8" in "\n".join(lines)) == (height > 24)


def test_the_richest_that_fits_is_shown() -> None:
    # 2 of the frame, 1 progress, 4 processes, 1 + 1 + n of the table, 2 learning, 1 causes: 12 + n, and a
    # blank line above each block but the first.
    assert layout(4, 23, 5) == Layout(3)  # 16 + 4 blank ones + 3
    assert layout(4, 50, 5) == Layout(5)
    assert layout(4, 20, 5) == Layout(0)  # without a log there are 3 blank ones
    assert layout(4, 19, 5) == Layout(0)
    assert layout(4, 18, 5) == Layout(0, blank=False)
    assert layout(4, 15, 5) == Layout(0, blank=False, middle=False)
    assert layout(4, 12, 5) == Layout(0, blank=False, middle=False)
    assert layout(4, 11, 5) == Layout(0, blank=False, middle=False, causes=False)


@pytest.mark.parametrize("count", [2, 4, 16])
def test_what_is_shown_has_the_height_that_was_planned(count: int) -> None:
    watch = watched(count)
    poorest = 7 + count
    for height in (*range(poorest, poorest + 14), 50):
        lines, _ = shown(count, 80, height, watch)
        assert len(lines) < height or len(lines) == poorest == height


def test_trouble_is_named() -> None:
    watch = watched(4)
    watch.happened(Happening(5, "agent_service.2", "died", -9, "x"))
    watch.happened(Happening(5, "env_server.1", "died", -9, "x"))
    watch.happened(Happening(5, "env_server.1", "restarted", None, "x"))
    lines, line = shown(4, watch=watch)
    rows = {name: next(line for line in lines if name in line) for name in ("env0 ", "env1 ", "env2 ")}
    assert "● alive" in rows["env0 "] and "↻" not in rows["env0 "]
    assert "● env starting" in rows["env1 "] and "↻ 1" in rows["env1 "]
    assert "● agent down" in rows["env2 "]
    assert any("agent_service" in line and "● 1 down" in line for line in lines)
    assert any("env_server" in line and "● 1 starting" in line and "↻ 1" in line for line in lines)
    assert line.endswith("env_server.1 starting  agent_service.2 down  restarts 1")


def test_an_environment_that_has_ended_is_out_of_the_rates() -> None:
    watch = watched(4)
    for process in ("env_server.3", "agent_service.3"):
        watch.feed(ledger(process, seq=9, at_ns=2 * SECOND, final=True, counters={"ticks": 200}), 2 * SECOND)
    lines, line = shown(4, watch=watch)
    (row,) = [line for line in lines if "env3 " in line]
    assert "● ended" in row and "100.0" not in row
    assert "300.0 ticks/s" in "\n".join(lines)
    assert line.startswith("0:02  4 x 100.0 Hz") and line.endswith(
        "env_server.3 ended  agent_service.3 ended"
    )


def test_without_a_terminal_it_is_one_line() -> None:
    _, line = shown(4)
    assert line == (
        "0:02  4 x 100.0 Hz  missed 6  loop p99 4,000 µs  window 0, update 3 of 7  policy 7/4  "
        "200 updates/s  return -1.5"
    )


def test_before_anything_came_the_processes_are_counted() -> None:
    lines, line = shown(4, watch=Watch(100.0))
    assert line == (
        "starting: env_server 4 starting, agent_service 4 starting, learner starting, recorder starting"
    )
    assert sum("● starting" in line for line in lines) == 8  # four roles, four environments
    assert told({"env_server.0": "alive", "env_server.1": "down", "learner": "alive"}) == [
        "env_server 1 alive 1 down", "learner alive"
    ]  # fmt: skip


@pytest.mark.parametrize("width", [80, 100])
def test_the_report_has_a_row_for_each_environment(width: int, tmp_path: Path) -> None:
    file = io.StringIO()
    console = Console(file=file, width=width, color_system=None)
    restarts = {"agent_service.2": 1, "env_server.2": 1}
    summary = summarise(FLEET, "r1", fleet_run(), wall_s=4.5, restarts=restarts, ended="duration")
    console.print(report.render(summary, RunDir.create(tmp_path / "r1", FLEET)))
    lines = file.getvalue().splitlines()
    rows = {line.split()[1]: line.split()[2:-1] for line in lines if " env" in line and "%" in line}
    assert rows == {
        "env0": ["200", "3", "(1.50", "%)", "2", "-20.00", "198", "0", "3", "0"],
        "env1": ["100", "1", "(1.00", "%)", "1", "-5.00", "97", "2", "2", "0"],
        "env2": ["50", "0", "(0.00", "%)", "1", "7.00", "49", "0", "4", "2"],
    }
    text = "\n".join(lines)
    for words in (
        "350 at 3 x 100.0 Hz",
        "4  (1.14 %)",
        "346 produced, 344 learned, 2 lost, 5 duplicate",
        "reconcile",
        "env_server 1, agent_service 1",
    ):
        assert words in text, words
    assert "▁" not in text  # returns of several environments one after the other are no curve
