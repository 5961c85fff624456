"""Going on where an earlier learner of the same run ended in order."""

from __future__ import annotations

from learner import checkpoint
from learner.algorithm import Algorithm
from learner.intake import Intake
from rtcore.run_dir import RunDir

CHECKPOINT_DIR = "checkpoint"  # in the learner's directory, as are the others
REPLAY_DIR = "replay"
SCHEDULE_FILE = "schedule.json"
PLACE = "intake"  # the checkpoint's scalar that says where in the log it was made


def save(run_dir: RunDir, algorithm: Algorithm, intake: Intake) -> None:
    """Write the checkpoint, in place of an older one."""
    state = algorithm.state()
    state.scalars[PLACE] = intake.place()
    checkpoint.save(run_dir.learner_dir / CHECKPOINT_DIR, state)


def restore(run_dir: RunDir, algorithm: Algorithm, intake: Intake) -> bool:
    """Load the run's checkpoint, if there is one; say whether there was.

    Raises:
        CheckpointError: there is one, and it is damaged or does not fit the configuration.
    """
    directory = run_dir.learner_dir / CHECKPOINT_DIR
    if not checkpoint.exists(directory):
        return False
    state = checkpoint.load(directory)
    place = state.scalars.pop(PLACE)
    algorithm.load(state)
    intake.go_on_from(place)
    return True


def last_published(run_dir: RunDir) -> int:
    """Version of the newest policy that was published in this run; 0 if none was."""
    policy = run_dir.read_policy()
    return 0 if policy is None else policy.version


def timetable(run_dir: RunDir) -> bytes | None:
    """The timetable that an earlier learner of the run kept; None if its configuration says it all."""
    try:
        return (run_dir.learner_dir / SCHEDULE_FILE).read_bytes()
    except FileNotFoundError:
        return None
