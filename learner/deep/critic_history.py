"""Frozen true copies of past critics, the material of a forecast."""

from __future__ import annotations

import torch

from learner.deep.gradients import Mlp
from learner.deep.networks import FlatParameters


class Snapshot:
    """The twin critics as they were at one instant. Nothing writes to them again.

    Attributes:
        time: the unit at whose beginning the critics were so: t + 1 for the end of unit t.
        parameters: memory of the snapshot's own.
        net: the same, ready for products.
    """

    def __init__(self, time: int, parameters: FlatParameters, precision: torch.dtype) -> None:
        self.time, self.parameters = time, parameters
        self.net = Mlp(parameters, precision)


class CriticHistory:
    """The newest `length` snapshots, oldest first."""

    def __init__(self, length: int, precision: torch.dtype) -> None:
        self._length, self._precision = length, precision
        self.snapshots: tuple[Snapshot, ...] = ()

    def push(self, time: int, critic: FlatParameters) -> None:
        """Copy `critic` as of `time`.

        Snapshots that are not older than `time` are dropped: the unit ended a second time, after a
        restart that went back.
        """
        older = tuple(snapshot for snapshot in self.snapshots if snapshot.time < time)
        self.restore((*older, Snapshot(time, critic.frozen_copy(), self._precision)))

    def restore(self, snapshots: tuple[Snapshot, ...]) -> None:
        """Hold the newest of `snapshots`, which come oldest first."""
        self.snapshots = snapshots[-self._length :]
