"""Two hosts, secured links, and a cable that is cut for two seconds; network namespaces stand for them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from benchmarks import two_hosts as hosts_run
from benchmarks.two_hosts import SPLIT, Summary, config
from launcher.chaos.netlab import missing, two_hosts
from launcher.summary import discrepancies
from rtcore import channels
from rtcore.run_dir import RunDir

pytestmark = [
    pytest.mark.skipif(missing() != "", reason=f"two network namespaces: {missing()}"),
    pytest.mark.timeout(120),
]

HZ, DURATION_S, BEFORE_S, CUT_S = 100.0, 5.5, 1.0, 2.0


@dataclass
class Story:
    """What was counted when the cable was cut, when it was restored, and in the end."""

    cut: Counter[str]
    restored: Counter[str]
    summary: Summary


def counted(home: Path) -> Counter[str]:
    """By all processes on both sides, at this instant."""
    found: Counter[str] = Counter()
    for side in set(SPLIT.values()):
        for stats in RunDir(home / side / "run").read_final_stats():
            found.update(stats.counters)
    return found


def play(home: Path) -> Story:
    seen: list[Counter[str]] = []
    with two_hosts() as hosts:

        def during() -> None:
            time.sleep(BEFORE_S)
            hosts.cut()
            seen.append(counted(home))
            time.sleep(CUT_S)
            seen.append(counted(home))
            hosts.restore()

        summary = hosts_run.play(hosts, home, config(home, hz=HZ, duration_s=DURATION_S), during=during)
    return Story(seen[0], seen[1], summary)


@pytest.fixture(scope="module")
def story(played: Callable[[str], Any]) -> Story:
    found: Story = played("test_two_hosts")
    return found


def test_what_was_lost_is_counted_exactly(story: Story) -> None:
    assert discrepancies(story.summary) == []
    transitions = story.summary["transitions"]
    assert story.summary["ticks"] + story.summary["deadlines"]["skipped"] == round(HZ * DURATION_S)
    assert transitions["produced"] == transitions["learned"] + transitions["lost"]
    assert transitions["lost"] == 0  # the log keeps what the cut held back for a hundred seconds
    assert story.summary["recorder"]["dropped"] == 0


def test_the_loop_goes_on_and_the_learner_hears_nothing_meanwhile(story: Story) -> None:
    """Otherwise the cable was not cut, or the loop went over it."""
    ticks = story.restored["ticks"] - story.cut["ticks"]
    assert ticks > 0.8 * HZ * CUT_S
    assert story.restored["actions"] - story.cut["actions"] > 0.8 * ticks
    assert story.restored["received"] - story.cut["received"] < 0.2 * ticks  # what was underway


def test_learning_goes_on_and_its_policies_act(story: Story) -> None:
    assert story.summary["transitions"]["learned"] > story.restored["learned"]
    assert story.summary["learner"]["gradient_steps"] > story.restored["gradient_steps"]
    assert story.summary["policies"]["adopted"] > story.restored["policies.adopted"]


def test_nobody_was_refused(story: Story) -> None:
    assert set(story.summary["links"].values()) == {0}
    assert len(story.summary["links"]) == 2 * len(channels.PROCESSES)
