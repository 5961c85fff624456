"""Going on where an earlier learner of the same run ended in order."""

from __future__ import annotations

import msgspec

from learner import checkpoint
from learner.algorithm import Algorithm
from rtcore.messages import Policy
from rtcore.run_dir import RunDir

CHECKPOINT_DIR = "checkpoint"  # in the learner's directory, as are the others
REPLAY_DIR = "replay"
POLICY_FILE = "policy.msgpack"  # the newest published policy, as it went over the bus


def save(run_dir: RunDir, algorithm: Algorithm) -> None:
    """Write the checkpoint, in place of an older one."""
    checkpoint.save(run_dir.learner_dir / CHECKPOINT_DIR, algorithm.state())


def restore(run_dir: RunDir, algorithm: Algorithm) -> bool:
    """Load the run's checkpoint into `algorithm`; False if there is none.

    Raises:
        CheckpointError: there is one, and it is damaged or does not fit the configuration.
    """
    directory = run_dir.learner_dir / CHECKPOINT_DIR
    if not checkpoint.exists(directory):
        return False
    algorithm.load(checkpoint.load(directory))
    return True


def last_published(run_dir: RunDir) -> int:
    """Version of the newest policy that was published in this run; 0 if none was."""
    try:
        data = (run_dir.learner_dir / POLICY_FILE).read_bytes()
    except FileNotFoundError:
        return 0
    return msgspec.msgpack.decode(data, type=Policy).version
