"""What an agent that starts again knows of the lives before it, and what it refuses by that."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import msgspec
import pytest
from msgspec.structs import replace

from agent_service.adoption import NEWEST, Adoption, Past
from agent_service.kept import Kept
from launcher.summary import Summary, discrepancies, summarise
from rtcore.channels import AGENT, LEARNER
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.files import write_atomic
from rtcore.ledger import Ledger
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Policy, Stats
from rtcore.run_dir import RunDir
from rtcore.signing import NoVerifier
from rtcore.tally import Tally
from rtcore.weights import WeightsError
from tests.agent_service.rig import SPEC, Rig, policy, step


@pytest.fixture
def run(tmp_path: Path) -> RunDir:
    return RunDir.create(tmp_path / "run", RunConfig())


def past(run: RunDir) -> Past:
    return Kept(run, Ledger(AGENT, 1), VirtualClock(), NoVerifier()).past()


def lived(run: RunDir, incarnation: int, **counters: int) -> None:
    with Tally.create(run.tally_path(AGENT, incarnation)) as tally:
        for name, value in counters.items():
            tally.set(name.replace("_", "."), value)


def offered(rig: Rig, *policies: Policy) -> list[int]:
    """The version behind the answer after each policy."""
    versions = []
    rig.specs.put(SPEC)
    for tick, one in enumerate(policies):
        rig.policies.put(one)
        answer = rig.answer(step(tick))
        assert answer is not None
        versions.append(answer.policy_version)
    return versions


def summary_of(published: int, *lives: Stats) -> Summary:
    """Of a run of that many policies and these lives of the agent."""
    learner = Ledger(LEARNER, 1)
    learner.count("published", published)
    stats = {AGENT: lives, LEARNER: [learner.stats(0, final=True)]}
    return summarise(RunConfig(), "run", stats, wall_s=0.0, restarts={})


def test_the_first_life_has_no_past(run: RunDir) -> None:
    found = past(run)
    assert (found.newest, found.floor) == (None, 0)


def test_the_floor_is_what_the_last_life_with_a_policy_had(run: RunDir) -> None:
    """Lives 9 and 10: compared as names, the 9 would be the later one. The newest died before its first."""
    lived(run, 9, policies_newest=4)
    lived(run, 10, policies_newest=7, ticks=3)
    lived(run, 11, ticks=0)
    assert past(run).floor == 7
    run.tally_path(AGENT, 12).write_bytes(b"torn")
    assert past(run).floor == 7


def test_the_newer_of_two_files_is_the_newest(run: RunDir) -> None:
    for path, version in ((run.policy_path, 3), (run.adopted_path(AGENT), 5)):
        path.parent.mkdir(exist_ok=True)
        write_atomic(path, msgspec.msgpack.encode(policy(version)))
    newest = past(run).newest
    assert newest is not None and newest.version == 5


class OnlyTo8:
    """A verifier that knows whose the versions up to 8 are."""

    def check(self, policy: Policy) -> None:
        if policy.version > 8:
            raise WeightsError("not the learner's")


@pytest.mark.parametrize(("learners", "kept"), [(None, 7), (6, 7), (7, None), (8, None), (9, 7)])
def test_the_agent_keeps_what_the_learner_has_not_written(
    run: RunDir, learners: int | None, kept: int | None
) -> None:
    """The learner's file may be older than what its bus brought, or nobody's."""
    if learners is not None:
        run.policy_path.parent.mkdir(exist_ok=True)
        write_atomic(run.policy_path, msgspec.msgpack.encode(policy(learners)))
    ledger = Ledger(AGENT, 1)
    Kept(run, ledger, VirtualClock(), OnlyTo8()).keep(policy(7))
    found = run.read_adopted(AGENT)
    assert (None if found is None else found.version) == kept
    assert ledger.counter("policies.foreign") == 0  # nobody wanted to act on it


def test_a_file_that_is_not_the_learners_is_in_no_account_of_policies(run: RunDir) -> None:
    """One is published, and taken; the file at the start claimed to be the ninth."""
    run.policy_path.parent.mkdir(exist_ok=True)
    write_atomic(run.policy_path, msgspec.msgpack.encode(policy(9)))
    rig = Rig(MemoryHub())
    past = Kept(run, rig.ledger, VirtualClock(), OnlyTo8()).past()
    assert past.newest is None
    assert offered(rig, policy(1)) == [1]
    summary = summary_of(1, rig.ledger.stats(0, final=True))
    assert discrepancies(summary) == []
    assert [summary["policies"][name] for name in ("foreign", "rejected", "unreceived")] == [1, 0, 0]


class Stages:
    """Stands for a tally: the counters after each store, as a kill right after it leaves them."""

    def __init__(self) -> None:
        self.states: list[dict[str, int]] = [{}]

    def set(self, name: str, value: int) -> None:
        self.states.append({**self.states[-1], name: value})

    def set_together(self, values: Mapping[str, int]) -> None:
        self.states.append({**self.states[-1], **values})


def test_the_fates_of_policies_add_up_wherever_a_life_is_killed() -> None:
    """Three are published and kept; whenever the first life ends, the next begins with the third."""
    rig, stages = Rig(MemoryHub()), Stages()
    rig.ledger._tally = cast("Tally", stages)
    assert offered(rig, policy(1), policy(2), policy(3)) == [1, 2, 3]
    assert len(stages.states) > 9
    first = rig.ledger.stats(0)
    for counters in stages.states:
        later = Rig(MemoryHub(), past=Past(newest=policy(3), floor=counters.get(NEWEST, 0)))
        assert offered(later, policy(3)) == [3]
        lives = replace(first, counters=counters), replace(later.ledger.stats(0, final=True), incarnation=2)
        policies = summary_of(3, *lives)["policies"]
        had = counters.get(NEWEST, 0)
        assert counters.get("policies.received", 0) == had
        assert (policies["received_again"], policies["unreceived"]) == (int(had == 3), max(0, 2 - had))
        assert discrepancies(summary_of(3, *lives)) == []


def test_a_policy_older_than_an_earlier_lifes_is_refused() -> None:
    rig = Rig(MemoryHub(), past=Past(newest=policy(4), floor=5))
    assert offered(rig, policy(3), policy(5), policy(4), policy(6)) == [0, 5, 5, 6]
    names = ("received", "past", "rejected", "adopted", "newest")
    assert [rig.ledger.counter(f"policies.{name}") for name in names] == [5, 3, 3, 2, 6]
    lines = [event.text for event in rig.ledger.stats(0).events if "refused" in event.text]
    assert lines == ["policy 4 refused: version 5 was there before"]  # one of three, in one instant


def test_the_newest_version_survives_in_the_tally(run: RunDir) -> None:
    rig = Rig(MemoryHub())
    with Tally.create(run.tally_path(AGENT, 1)) as tally:
        rig.ledger._tally = tally
        offered(rig, policy(8))
        assert past(run).floor == 8
    assert NEWEST == "policies.newest"


def test_a_policy_is_kept_before_it_counts_or_acts() -> None:
    """Killed in between, a life leaves a file that is newer than its floor, never an older one."""
    told: list[tuple[int, int]] = []
    rig = Rig(MemoryHub())

    def keep(one: Policy) -> None:
        told.append((one.version, rig.ledger.counter(NEWEST)))
        rig.steps.put(step(1))  # is answered now

    adoption = Adoption(SPEC, rig.ledger, past=Past(keep=keep))
    rig.specs.put(SPEC)
    rig.answer(step(0))
    rig.agent._adoption = adoption
    adoption.offer(policy(8), 0)
    assert told == [(8, 0)]
    answers = [received.message.policy_version for received in rig.actions.drain()]
    assert answers == [0]
    assert rig.ledger.counter(NEWEST) == 8


def test_the_fates_of_policies_add_up_over_lives_and_replays() -> None:
    """Two are published. The first life takes both, and a replay of the first; the next life gets the second
    again, from a file and from the bus, and another replay."""
    first, second = Rig(MemoryHub()), Rig(MemoryHub(), past=Past(newest=policy(2), floor=2))
    assert offered(first, policy(1), policy(2), policy(1)) == [1, 2, 2]
    assert offered(second, policy(2), policy(1)) == [2, 2]
    later = replace(second.ledger.stats(0, final=True), incarnation=2)
    summary = summary_of(2, first.ledger.stats(0, final=True), later)
    assert discrepancies(summary) == []
    policies = summary["policies"]
    names = ("published", "adopted", "rejected", "received_again", "unreceived")
    assert [policies[name] for name in names] == [2, 3, 2, 3, 0]
