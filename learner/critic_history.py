"""Frozen true copies of past critics, the material of a forecast."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from learner.networks import FlatParameters, min_q


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The twin critics as they were at one instant. Nothing writes to them again.

    Attributes:
        time: the unit at whose beginning the critics were so: t + 1 for the end of unit t.
        parameters: by name; memory of the snapshot's own.
    """

    time: int
    parameters: Mapping[str, Tensor]

    def value(self, observation: Tensor, action: Tensor) -> Tensor:
        """The smaller of both critics' values, [B], differentiable in `action`."""
        return min_q(tuple(self.parameters.values()), observation, action)


class CriticHistory:
    """The newest `length` snapshots, oldest first."""

    def __init__(self, length: int) -> None:
        self._length = length
        self.snapshots: tuple[Snapshot, ...] = ()

    def push(self, time: int, critic: FlatParameters) -> None:
        """Copy `critic` as of `time`.

        Snapshots that are not older than `time` are dropped: the unit ended a second time, after a
        restart that went back.
        """
        with torch.no_grad():
            copy = Snapshot(time, critic.views(critic.flat.clone()))
        older = tuple(snapshot for snapshot in self.snapshots if snapshot.time < time)
        self.restore((*older, copy))

    def restore(self, snapshots: tuple[Snapshot, ...]) -> None:
        """Hold the newest of `snapshots`, which come oldest first."""
        self.snapshots = snapshots[-self._length :]
