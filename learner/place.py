"""Where a learner stands in the run, as it is committed together with the rows of its replay."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from learner.diary import Acted
from rtcore.messages import Step

Position = tuple[int, int]


class Course(NamedTuple):
    """What the service does with what it takes in."""

    earned: float = 0.0  # gradient steps, by all learners of the run
    settled: int = -1  # newest unit whose iterate was due
    paused: bool = False  # by an operator


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """How far one environment's log was taken in. New fields have defaults.

    Attributes:
        position: (incarnation, seq) of the step of the log that comes next; None: none came.
        previous: the step that the next one may follow.
        counts: the intake's counters, added over all learners of the run.
        acted: ticks of the present unit, for the diary.
    """

    position: Position | None = None
    previous: Step | None = None
    counts: dict[str, int] = {}
    acted: Acted | None = None


class Place(msgspec.Struct, frozen=True, kw_only=True):
    """What a later learner of the run needs, beside the algorithm's own state. New fields have defaults.

    Attributes:
        envs: by the environment's name, all those of the run. Without a default: a note that does not have
            it is of another version, and no beginning.
        course: of the service.
    """

    envs: dict[str, Progress]
    course: Course = Course()

    @classmethod
    def beginning(cls, envs: Collection[str]) -> Place:
        """Where the first learner of a run stands."""
        return cls(envs={env: Progress() for env in envs})

    @property
    def counts(self) -> dict[str, int]:
        """The counters over all environments."""
        total: Counter[str] = Counter()
        for progress in self.envs.values():
            total.update(progress.counts)
        return dict(total)

    def encode(self) -> bytes:
        """Without what no transition is made of."""
        envs = {env: _stripped(progress) for env, progress in self.envs.items()}
        return msgspec.msgpack.encode(replace(self, envs=envs))

    @classmethod
    def decode(cls, note: bytes) -> Place:
        """The place in a committed note.

        Raises:
            ValueError: another version wrote it.
        """
        try:
            return msgspec.msgpack.decode(note, type=cls)
        except RecursionError as error:
            raise ValueError("not a place: nested too deeply") from error


def _stripped(progress: Progress) -> Progress:
    if progress.previous is None:
        return progress
    return replace(
        progress, previous=replace(progress.previous, action=b"", decision=b"", position=b"", physics=[])
    )
