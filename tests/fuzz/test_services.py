"""All services in virtual time beside a rogue: all is counted, and what is refused has no effect."""

from __future__ import annotations

import logging
import random
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import get_args, get_type_hints

import msgspec
import pytest

from launcher.summary import summarise
from rtcore import channels
from rtcore.config import ScheduleConfig
from rtcore.messages import Command, EpisodeReturn, Stats
from tests.fuzz.hostile import Hostile
from tests.fuzz.mutations import mutate_command
from tests.fuzz.rogue import Accounts, RogueRun, Speaker, small

DURATION_S = 15.0
TICKS = 750


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


def test_a_hundred_thousand_mutated_messages_are_all_accounted_for(
    tmp_path: Path,
    stack: ExitStack,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    messages: int,
) -> None:
    ticks = 2 * TICKS  # so that no queue of the recorder's is full before it looks
    run = RogueRun(tmp_path / "run", small(2 * DURATION_S), stack)
    accounts = Accounts(monkeypatch)
    speaker = Speaker(run, accounts, seed=1)
    with caplog.at_level(logging.INFO):
        outcome = run.run(lambda tick: speaker.speak(-(-(messages - speaker.sent) // (ticks - tick))))
    assert speaker.sent >= messages
    assert outcome.final["env_server"].counters["ticks"] == ticks
    rejected = run.rejected()
    assert set(accounts.delivered) == {channel.name for channel in channels.TABLE}
    for name, delivered in accounts.delivered.items():
        # Of the declarations the learner and the recorder read the newest alone, and the agent those that are
        # there when it needs one; what its queue lost counts as refused.
        unread = delivered - accounts.accepted[name] - accounts.refused[name]
        assert unread == 0 or name == "spec"
        # What decodes may still be refused by who knows more, and is counted then.
        assert accounts.refused[name] <= rejected[name] <= delivered
        assert accounts.refused[name] > delivered / 4 and accounts.accepted[name] > 0
    # 13 readers may each write a line in ten seconds, and the agent one a second about policies; the rest is
    # what the run says anyway.
    assert len(caplog.records) < 300
    summarise(run.config, "run", outcome.watch.stats(), wall_s=1.0, restarts={})  # whatever the numbers are


def test_mutated_commands_are_answered_or_counted(tmp_path: Path, stack: ExitStack) -> None:
    run = RogueRun(tmp_path / "run", small(DURATION_S), stack)
    rng = random.Random(2)
    true = [
        msgspec.msgpack.encode(Command(id=f"{verb}", verb=verb))
        for verb in get_args(get_type_hints(Command)["verb"])
    ]
    true.append(msgspec.msgpack.encode(Command(id="s", verb="schedule", schedule=ScheduleConfig())))
    answered = Counter[bool]()

    def speak(tick: int) -> None:
        for name in ("learner", "agent_service", "env_server") if tick >= 100 else ():
            payload = mutate_command(rng, true)
            answered[run.ask(name, payload) is not None] += 1

    outcome = run.run(speak)
    assert outcome.final["env_server"].counters["ticks"] == TICKS
    assert run.rejected() == {"control": answered[False]}
    assert min(answered[True], answered[False]) > 150


def test_what_is_refused_leaves_the_run_as_it_would_have_been_to_the_bit(
    tmp_path: Path, stack: ExitStack
) -> None:
    undisturbed = RogueRun(tmp_path / "undisturbed", small(DURATION_S), stack).run(lambda _: None)
    run = RogueRun(tmp_path / "run", small(DURATION_S), stack)
    hostile = Hostile(run, seed=3)
    disturbed = run.run(hostile.speak)
    assert hostile.sent > 10_000
    assert len(disturbed.policies) > 5
    assert disturbed.policies == undisturbed.policies
    assert disturbed.log == undisturbed.log
    for name in ("env_server", "agent_service", "learner"):
        assert books(disturbed.final[name]) == books(undisturbed.final[name])
    rejected = run.rejected()
    assert all(rejected[channel.name] > 500 for channel in channels.TABLE)
    agent, env = disturbed.final["agent_service"].counters, disturbed.final["env_server"].counters
    learner = disturbed.final["learner"].counters
    judged = [agent["observations.repeated"], agent["observations.invalid"], agent["observations.unknown"]]
    judged += [agent["policies.rejected"], env["action.stale"], learner["duplicate"]]
    assert min(judged) > 50


REFUSALS = (
    "messages.", "observations", "action.stale", "action.invalid", "policies.re", "policies.past",
    "duplicate", "received", "events.dropped",
)  # fmt: skip


def books(stats: Stats) -> tuple[dict[str, int], list[EpisodeReturn], dict[str, bytes]]:
    """What a process counted, but for what it refused; and what it measured of the true messages."""
    counters = {name: n for name, n in stats.counters.items() if not name.startswith(REFUSALS)}
    return counters, stats.returns, {"pacing": stats.histograms.get("pacing", b"")}
