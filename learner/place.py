"""Where a learner stands in the run, as it is committed together with the rows of its replay."""

from __future__ import annotations

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


class Place(msgspec.Struct, frozen=True, kw_only=True):
    """What a later learner of the run needs, beside the algorithm's own state. New fields have defaults.

    Attributes:
        position: (incarnation, seq) of the step of the log that comes next; None: none came.
        previous: the step that the next one may follow.
        counts: the intake's counters, added over all learners of the run.
        course: of the service.
        acted: ticks of the present unit, for the diary.
    """

    position: Position | None = None
    previous: Step | None = None
    counts: dict[str, int] = {}
    course: Course = Course()
    acted: Acted | None = None

    def encode(self) -> bytes:
        """Without what no transition is made of."""
        previous = self.previous
        if previous is not None:
            previous = replace(previous, action=b"", decision=b"", position=b"", physics=[])
        return msgspec.msgpack.encode(replace(self, previous=previous))

    @classmethod
    def decode(cls, note: bytes) -> Place:
        """The place in a committed note; the beginning, of an empty one.

        Raises:
            ValueError: another version wrote it.
        """
        try:
            return msgspec.msgpack.decode(note, type=cls) if note else cls()
        except RecursionError as error:
            raise ValueError("not a place: nested too deeply") from error
