"""What a killed learner leaves to the next one, and what becomes of that which does not fit."""

from __future__ import annotations

from dataclasses import replace

import pytest

from learner import checkpoint, meeting, outbox
from learner.intakes import Intakes
from learner.replay import Replay, open_replay
from rtcore.config import ConfigError, LearnerConfig, RunConfig
from rtcore.run_dir import RunDir
from tests.learner.service_rig import CONFIG, SPEC, TICK_NS, Rig


class Killed(BaseException):
    """Here the process ends."""


def killed(*_: object, **__: object) -> None:
    raise Killed


def config(**learner: object) -> RunConfig:
    """With a checkpoint every second, unless told otherwise."""
    changed: LearnerConfig = replace(CONFIG.learner, **{"checkpoint_s": 1.0, **learner})  # type: ignore[arg-type]
    return replace(CONFIG, learner=changed)


def start(run_dir: RunDir, run: RunConfig | None = None, at: int = 0) -> Rig:
    """A learner that meets the world at tick `at`."""
    rig = Rig(run_dir, run or config())
    rig.clock.sleep_until_ns(at * TICK_NS)
    rig.specs.put(SPEC)
    return rig


def counted(run_dir: RunDir, name: str) -> int:
    """Over all lives."""
    return sum(stats.counters.get(name, 0) for stats in run_dir.read_final_stats())


def events(rig: Rig) -> list[str]:
    return [event.text for event in rig.ledger.stats(rig.clock.now_ns()).events]


def held(run_dir: RunDir) -> Replay:
    return open_replay(run_dir.learner_dir / "replay", 1000, 2, 1)


# -- killed


def test_killed_before_the_first_checkpoint_it_learns_from_the_replay_again(run_dir: RunDir) -> None:
    start(run_dir).live(0, 8)
    second = start(run_dir, at=9)
    second.live(5, 9)
    assert counted(run_dir, "learned") == 9
    assert second.ledger.counter("gradient_steps") == 4  # as many as transitions after the first 5
    assert "goes on from no checkpoint: policy 0, 8 transitions in the replay" in events(second)


def test_steps_that_are_not_in_the_checkpoint_are_made_again(run_dir: RunDir) -> None:
    """By tick 10, when unit 0 has ended, 10 transitions have earned 5 steps; by tick 15, 10."""
    first = start(run_dir)
    first.live(0, 10)
    first.learner.keeper.flush()
    first.live(11, 15)
    saved = checkpoint.load(run_dir.learner_dir / "checkpoint").scalars
    assert (saved["gradient_steps"], saved["budget"]) == (4, [5.0, 4])  # tick 10's own step comes after
    assert first.ledger.counter("gradient_steps") == 10
    second = start(run_dir, at=16)
    second.live(16, 16)
    assert second.ledger.counter("gradient_steps") == 11 - 4


def test_what_was_committed_and_not_counted_is_counted_by_the_next(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = start(run_dir)
    first.live(0, 10)
    with monkeypatch.context() as patch:
        patch.setattr(Intakes, "_account", killed)
        with pytest.raises(Killed):
            first.live(11, 11)
    assert (held(run_dir).added, counted(run_dir, "learned"), counted(run_dir, "received")) == (11, 10, 11)
    start(run_dir, at=12).live(8, 12)
    assert (held(run_dir).added, counted(run_dir, "learned")) == (12, 12)
    assert counted(run_dir, "received") == 12 + 1 + 4  # 8 to 11 once more


def test_killed_before_the_commit_the_step_is_taken_again(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = start(run_dir)
    first.live(0, 10)
    with monkeypatch.context() as patch:
        patch.setattr(Replay, "commit", killed)
        with pytest.raises(Killed):
            first.live(11, 11)
    start(run_dir, at=12).live(8, 12)
    assert (held(run_dir).added, counted(run_dir, "learned")) == (12, 12)


def test_killed_between_the_file_and_the_bus_the_next_sends_the_same_policy(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = start(run_dir)
    monkeypatch.setattr(first.learner.outbox._policies, "put", killed)
    with pytest.raises(Killed):
        first.live(0, 9)  # iterate 1 is due
    kept = run_dir.read_policy()
    assert kept is not None and (kept.version, first.published()) == (1, [])
    second = start(run_dir, at=9)
    second.live(5, 19)
    again, following = second.published()
    assert again == kept
    assert (following.version, following.iterate) == (2, 2)


def test_killed_before_the_file_the_version_is_never_used(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = start(run_dir)
    with monkeypatch.context() as patch:
        patch.setattr(outbox, "write_atomic", killed)
        with pytest.raises(Killed):
            first.live(0, 9)
    assert run_dir.read_policy() is None
    second = start(run_dir, at=9)
    second.live(5, 19)
    assert [(p.version, p.window, p.iterate) for p in second.published()] == [(2, 0, 2)]


def test_versions_rise_and_no_iterate_comes_twice_without_a_checkpoint(run_dir: RunDir) -> None:
    first = start(run_dir, config(checkpoint_s=1e9))
    first.live(0, 19)
    assert [(p.version, p.iterate) for p in first.published()] == [(1, 1), (2, 2)]
    second = start(run_dir, at=19)  # iterate 2 would be due again
    second.live(15, 59)
    assert [(p.version, p.window, p.iterate) for p in second.published()] == [(2, 0, 2), (3, 1, 1), (4, 1, 2)]


def test_an_operators_hold_outlives_the_learner(run_dir: RunDir) -> None:
    first = start(run_dir)
    first.live(0, 4)
    first.order("hold")
    first.live(5, 5)
    second = start(run_dir, at=6)
    second.live(6, 12)
    assert second.published() == []
    assert [notice.message.reason for notice in second.windows.drain()] == ["operator"]
    second.order("resume")
    second.live(13, 19)
    assert [p.iterate for p in second.published()] == [2]


# -- what does not fit


def test_a_refusal_leaves_everything_as_it_was(run_dir: RunDir) -> None:
    first = start(run_dir)
    first.live(0, 19)
    first.learner.close()
    files = {path: path.read_bytes() for path in run_dir.learner_dir.rglob("*") if path.is_file()}
    second = start(run_dir, config(hidden=(8, 4)), at=20)
    with pytest.raises(
        ConfigError, match=r"learner.on_mismatch = 'refuse': must be 'fresh'.*hidden \[8, 8\]"
    ):
        second.live(20, 20)
    second.learner.close()
    assert files == {path: path.read_bytes() for path in run_dir.learner_dir.rglob("*") if path.is_file()}


def test_a_checkpoint_that_does_not_fit_is_set_aside_and_the_replay_is_kept(run_dir: RunDir) -> None:
    first = start(run_dir)
    first.live(0, 19)
    first.learner.close()
    second = start(run_dir, config(hidden=(8, 4), on_mismatch="fresh"), at=20)
    second.live(20, 29)
    assert (run_dir.learner_dir / "checkpoint.set-aside-1" / "manifest.json").is_file()
    assert any(text.startswith("checkpoint set aside as checkpoint.set-aside-1: ") for text in events(second))
    assert (held(run_dir).added, counted(run_dir, "learned")) == (29, 29)
    assert second.ledger.counter("gradient_steps") == 10  # no arrears
    second.learner.close()
    assert checkpoint.load(run_dir.learner_dir / "checkpoint").scalars["hidden"] == [8, 4]


def test_a_replay_that_does_not_fit_is_set_aside_and_the_checkpoint_is_kept(run_dir: RunDir) -> None:
    first = start(run_dir)
    first.live(0, 19)
    first.learner.close()
    second = start(run_dir, config(replay_capacity=500, on_mismatch="fresh"), at=20)
    second.live(18, 31)
    assert (run_dir.learner_dir / "replay.set-aside-1" / "marks.bin").is_file()
    fresh = open_replay(run_dir.learner_dir / "replay", 500, 2, 1)
    assert fresh.added == 12  # 20 to 31; it goes on where the other one ended
    assert second.ledger.counter("gradient_steps") == 7  # after 5 transitions
    assert counted(run_dir, "learned") == 31
    third = start(run_dir, config(replay_capacity=500, on_mismatch="fresh"), at=32)
    third.live(30, 33)
    assert counted(run_dir, "learned") == 33


def test_killed_right_after_it_set_a_replay_aside_the_next_goes_on_where_that_one_ended(
    run_dir: RunDir, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twice: then the one set aside last has nothing to go on from."""
    start(run_dir).live(0, 19)
    for capacity in (500, 400):
        with monkeypatch.context() as patch:
            patch.setattr(meeting, "make_algorithm", killed)
            with pytest.raises(Killed):
                start(run_dir, config(replay_capacity=capacity, on_mismatch="fresh"), at=20).live(18, 20)
    start(run_dir, config(replay_capacity=400, on_mismatch="fresh"), at=21).live(10, 31)
    assert open_replay(run_dir.learner_dir / "replay", 400, 2, 1).added == 12  # 20 to 31
    assert counted(run_dir, "learned") == 31
