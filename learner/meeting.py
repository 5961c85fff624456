"""What a learner begins with, once it knows the world: everything that earlier ones of the run left."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from learner import resume
from learner.algorithm import Algorithm, make_algorithm
from learner.marks import Record, peek
from learner.place import Place
from learner.replay import Replay, ReplayError, open_replay
from learner.resume import Budget, Published
from learner.store import MARKS
from rtcore.cast import env_names
from rtcore.clock import Clock
from rtcore.config import RunConfig
from rtcore.files import sweep
from rtcore.ledger import Ledger
from rtcore.messages import Spec
from rtcore.run_dir import RunDir
from rtcore.spaces import Spaces

LEARNER_STREAM = 2  # keeps the learner's random numbers apart from the world's and the agent's


@dataclass(frozen=True, slots=True)
class Beginning:
    """A learner's replay and algorithm, and where it goes on.

    Attributes:
        replay: with all that was committed to it.
        algorithm: over it, as of the newest checkpoint.
        place: committed together with the replay.
        counted: counters of the learners before.
        published: policies so far.
        settled: newest unit whose iterate was due or published.
    """

    replay: Replay
    algorithm: Algorithm
    place: Place
    counted: Counter[str]
    published: Published
    settled: int


def meet(
    config: RunConfig, run_dir: RunDir, spec: Spec, budget: Budget, clock: Clock, ledger: Ledger
) -> Beginning:
    """Take up what earlier learners of the run left; `budget` goes on by it as well.

    Raises:
        ConfigError: something does not fit, and `learner.on_mismatch` is "refuse".
    """

    def tell(text: str) -> None:
        ledger.event(clock.now_ns(), "WARN", text)

    for name in ("", resume.REPLAY_DIR, resume.CHECKPOINT_DIR):
        sweep(run_dir.learner_dir / name)
    replay, place = _held(config, run_dir, spec, tell)
    seed = config.seed * 10 + LEARNER_STREAM
    algorithm = make_algorithm(config, Spaces.of(spec), seed, replay)
    directory = run_dir.learner_dir / resume.CHECKPOINT_DIR
    restored, aside = resume.fitting(
        lambda: resume.restore(run_dir, algorithm), directory, fresh=_fresh(config), tell=tell
    )
    saved = restored or resume.Spent()
    earned = max(place.course.earned, saved.earned)
    # an algorithm that starts anew has no arrears, and on a replay that does there is nothing to make them up
    forgiven = aside is not None or len(replay) == 0
    budget.resume(len(replay), earned, round(earned) if forgiven else saved.spent)
    counted, version = resume.ledgers(run_dir)
    published = resume.published(run_dir, version)
    if restored is not None or len(replay):
        source = "no checkpoint" if restored is None else "the checkpoint"
        text = f"goes on from {source}: policy {published.version}, {len(replay)} transitions in the replay"
        ledger.event(clock.now_ns(), "INFO", text)
    settled = max(place.course.settled, _published_in(published, spec, clock.now_ns()))
    return Beginning(replay, algorithm, place, counted, published, settled)


def _fresh(config: RunConfig) -> bool:
    return config.learner.on_mismatch == "fresh"


def _held(
    config: RunConfig, run_dir: RunDir, spec: Spec, tell: Callable[[str], None]
) -> tuple[Replay, Place]:
    """The replay, and where the run stands with it."""
    directory, envs = run_dir.learner_dir / resume.REPLAY_DIR, env_names(config.env)
    dims = spec.observation_dim, spec.action_dim

    def load() -> tuple[Replay, Place]:
        found = open_replay(directory, config.learner.replay_capacity, *dims, envs=len(envs))
        return found, _place(found.committed, envs)

    (replay, place), _ = resume.fitting(load, directory, fresh=_fresh(config), tell=tell)
    if replay.committed is None or not replay.committed.note:
        place = _left(directory, envs)
    return replay, place


def _published_in(published: Published, spec: Spec, now_ns: int) -> int:
    """The unit of the newest policy, which reaches the disk before anybody gets it; -1: it says nothing."""
    newest = published.policy
    if newest is None or newest.created_ns > now_ns:  # a stamp ahead of the clock is of an earlier boot
        return -1
    return (newest.created_ns - spec.t0_ns) // spec.unit_ns


def _left(directory: Path, envs: Collection[str]) -> Place:
    """Where the run stands, for a replay that nothing was committed to: where the one ended that the disk
    does not give back, or that was set aside last. What came until then is neither learned again nor lost."""
    for path in (directory, *resume.set_aside(directory)):
        record = peek(path / MARKS)
        if record is not None and record.note:
            with suppress(ReplayError):
                return _place(record, envs)
            break
    return Place.beginning(envs)


def _place(record: Record | None, envs: Collection[str]) -> Place:
    if record is None or not record.note:
        return Place.beginning(envs)
    try:
        place = Place.decode(record.note)
    except ValueError as error:
        raise ReplayError(f"the replay's place in the log is not readable: {error}") from error
    if place.envs.keys() != set(envs):
        raise ReplayError(f"the replay is of {', '.join(place.envs)} (wanted {', '.join(envs)})")
    return place
