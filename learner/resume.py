"""What earlier learners of the same run left, and what becomes of that which does not fit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import count, takewhile
from pathlib import Path
from typing import NamedTuple, TypeVar

from learner import checkpoint
from learner.algorithm import Algorithm
from learner.budget import TableBudget, UpdateBudget
from learner.checkpoint import CheckpointError, State
from learner.replay import ReplayError
from rtcore import channels
from rtcore.config import ConfigError
from rtcore.messages import Policy
from rtcore.run_dir import RunDir

CHECKPOINT_DIR = "checkpoint"  # in the learner's directory, as are the others
REPLAY_DIR = "replay"
SCHEDULE_FILE = "schedule.json"
BUDGET = "budget"  # the checkpoint's scalar that says what its steps have cost

Budget = UpdateBudget | TableBudget
FoundT = TypeVar("FoundT")


class Spent(NamedTuple):
    """The budget when a checkpoint was made."""

    earned: float = 0.0
    spent: int = 0


class Published(NamedTuple):
    """What was published so far."""

    version: int  # of the newest, or of one whose sending a kill prevented; 0: none
    policy: Policy | None  # the newest that reached the disk


def state(algorithm: Algorithm, budget: Budget) -> State:
    """What a checkpoint holds, as copies."""
    found = algorithm.state()
    found.scalars[BUDGET] = [budget.earned, budget.spent]
    return found


def restore(run_dir: RunDir, algorithm: Algorithm) -> Spent | None:
    """Load the run's checkpoint; None if there is none.

    Raises:
        CheckpointError: there is one, and it is damaged or does not fit the configuration.
    """
    directory = run_dir.learner_dir / CHECKPOINT_DIR
    if not checkpoint.exists(directory):
        return None
    found = checkpoint.load(directory)
    try:
        earned, spent = found.scalars.pop(BUDGET)
        cost = Spent(float(earned), int(spent))
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{directory}: {BUDGET} not readable ({error!r})") from error
    algorithm.load(found)
    return cost


def fitting(
    load: Callable[[], FoundT], path: Path, *, fresh: bool, tell: Callable[[str], None]
) -> tuple[FoundT, Path | None]:
    """What `load` finds in `path`, or, where that does not fit, after it was set aside.

    Args:
        load: says ReplayError or CheckpointError to what does not fit.
        path: a directory.
        fresh: whether it may be set aside.
        tell: is told if it was.

    Returns:
        What was found, and where what did not fit is now.

    Raises:
        ConfigError: it does not fit and may not be set aside.
    """
    try:
        return load(), None
    except (ReplayError, CheckpointError) as error:
        if not fresh:
            allowed = f"must be 'fresh' to set aside what does not fit: {error}"
            raise ConfigError("learner.on_mismatch", "refuse", allowed) from error
        aside = _set_aside(path)
        tell(f"{path.name} set aside as {aside.name}: {error}")
        return load(), aside


def set_aside(path: Path) -> list[Path]:
    """Where that which did not fit in `path` is now, the newest first."""
    names = (path.with_name(f"{path.name}.set-aside-{number}") for number in count(1))
    return list(takewhile(Path.exists, names))[::-1]


def published(run_dir: RunDir, version: int) -> Published:
    """What the run has published, by its newest policy on the disk and by the ledgers' newest `version`."""
    policy = run_dir.read_policy()
    return Published(version if policy is None else max(version, policy.version), policy)


def ledgers(run_dir: RunDir) -> tuple[Counter[str], int]:
    """The counters of all learners of the run so far, added up; and the newest version in any of them."""
    lives = [stats for stats in run_dir.read_final_stats() if stats.process == channels.LEARNER]
    counted: Counter[str] = Counter()
    for stats in lives:
        counted.update(stats.counters)
    return counted, max((stats.counters.get("last_version", 0) for stats in lives), default=0)


def timetable(run_dir: RunDir) -> bytes | None:
    """The timetable that an earlier learner of the run kept; None if its configuration says it all."""
    try:
        return (run_dir.learner_dir / SCHEDULE_FILE).read_bytes()
    except FileNotFoundError:
        return None


def _set_aside(path: Path) -> Path:
    return path.rename(path.with_name(f"{path.name}.set-aside-{len(set_aside(path)) + 1}"))
