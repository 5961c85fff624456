"""What an agent that starts again knows of the lives before it, and what it refuses by that."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from agent_service.adoption import NEWEST, Adoption, Past
from agent_service.kept import Kept
from launcher.summary import discrepancies, summarise
from rtcore.channels import AGENT, LEARNER
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.files import write_atomic
from rtcore.ledger import Ledger
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Policy
from rtcore.run_dir import RunDir
from rtcore.signing import NoVerifier
from rtcore.tally import Tally
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
    for path, version in ((run.policy_path, 3), (run.adopted_path, 5)):
        path.parent.mkdir(exist_ok=True)
        write_atomic(path, msgspec.msgpack.encode(policy(version)))
    newest = past(run).newest
    assert newest is not None and newest.version == 5


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
    learner = Ledger(LEARNER, 1)
    learner.count("published", 2)
    lives = [first.ledger.stats(0, final=True), second.ledger.stats(0, final=True)]
    lives[1] = msgspec.structs.replace(lives[1], incarnation=2)
    stats = {AGENT: lives, LEARNER: [learner.stats(0, final=True)]}
    summary = summarise(RunConfig(), "run", stats, wall_s=0.0, restarts={})
    assert discrepancies(summary) == []
    policies = summary["policies"]
    names = ("published", "adopted", "rejected", "received_again", "unreceived")
    assert [policies[name] for name in names] == [2, 3, 2, 3, 0]
